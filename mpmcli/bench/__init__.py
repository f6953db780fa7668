"""Speed of mpmcli and of the MPM examples in the taichi package, measured alternately."""
