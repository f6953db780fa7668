"""What `mpmcli check` finds: in a scene before it runs, and in a result after."""
