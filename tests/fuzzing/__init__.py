"""Damaged input for every reader of mpmcli, and what comes of it."""
