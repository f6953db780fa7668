"""Child processes: one process per task, and pools for the many tasks of one job."""
