"""The studio: a local page on which a style is put on a mesh while one watches (extra ``studio``).

`workbench` holds what is being made and works on it in a thread of its own; `app` serves it to a
browser on this machine; the page is in ``page``.
"""
