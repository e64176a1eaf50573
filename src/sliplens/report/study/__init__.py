"""The part of a report that a study adds: which explanations can be believed, and every figure of the thesis."""
