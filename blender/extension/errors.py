"""The extension's one exception."""


class ExtensionError(Exception):
    """What the artist reads: one sentence that says what is wrong and what to do."""
