"""`mpmcli check`: the check of a scene before it runs, and of a result after."""
