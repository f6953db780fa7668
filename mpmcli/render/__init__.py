"""Pictures and films of stored frames."""
