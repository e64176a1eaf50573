"""Records that workflows return and reports load; none needs torch."""
