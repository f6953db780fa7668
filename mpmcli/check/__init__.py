"""`mpmcli check`: checks a scene before its run, and a result after it."""
