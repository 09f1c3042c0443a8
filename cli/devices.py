"""`mill devices`."""
