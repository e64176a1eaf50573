"""Records of the saved results that reports load."""
