"""Helpers of the recipes that make or read offline data."""
