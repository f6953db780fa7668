"""Pictures and films as files: whole or absent, the same bytes for the same pixels."""
