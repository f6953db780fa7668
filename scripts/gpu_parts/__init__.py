"""The parts of scripts/gpu: what is measured on a GPU, each part in a process of its own."""
