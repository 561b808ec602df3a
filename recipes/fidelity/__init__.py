"""What a short chain changes: the parts of `chain_fidelity.py`."""
