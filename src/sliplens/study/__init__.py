"""The experiment: choose frames, explain them, score the explanations."""
