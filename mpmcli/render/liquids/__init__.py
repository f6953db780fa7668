"""`--mode fluid`: liquids drawn from the picture of their particles, in screen space."""
