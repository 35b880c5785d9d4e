"""The tests, in folders as the package's own; what they share is in `tests.helpers`."""
