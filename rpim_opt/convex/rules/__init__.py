"""Rules that choose the weight of the penalty from the identification data alone."""
