"""A soak: scenes computed again and again in one process, with their laws, their bytes and the memory watched."""
