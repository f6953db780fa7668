"""Checks whether the components that mpmcli needs work on this machine, and suggests remedies."""
