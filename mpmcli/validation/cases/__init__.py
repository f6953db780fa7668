"""The validation cases, one file each: a module here offers its cases as CASES."""
