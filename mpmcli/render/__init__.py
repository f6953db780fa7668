"""Pictures and films of results, without a screen."""
