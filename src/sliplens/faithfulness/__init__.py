"""Scores of explanations: removal of parts against controls, the deletion score of the thesis, sanity checks."""
