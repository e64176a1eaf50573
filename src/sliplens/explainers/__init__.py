"""Explanations of f(x) - f(reference): signed relevance in margin units."""
