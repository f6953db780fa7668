"""Scenes that break solvers of this kind, each with what must happen: survive, or stop with the right diagnosis."""
