"""Speed of mpmcli beside the MPM examples that the taichi package ships, measured in turn."""
