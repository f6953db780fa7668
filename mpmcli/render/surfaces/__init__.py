"""`--mode surface`: materials as bodies with a surface, in space and in the plane."""
