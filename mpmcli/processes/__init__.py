"""Processes of our own: questions with one answer each, and pools that carry out many tasks of one job."""
