"""Pictures and films of frames, without a screen."""
