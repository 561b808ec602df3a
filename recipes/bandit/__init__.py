"""Helpers of `bandit_2d.py`."""
