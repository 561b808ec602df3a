"""Helpers of `study.py`: its jobs, where they run, and how far they are."""
