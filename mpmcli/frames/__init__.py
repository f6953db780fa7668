"""The output of a run at each output time: a frame of particles and a row of the ledger."""
