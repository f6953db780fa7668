"""One run from a loaded scene to a stored result."""
