"""Many runs: the points of a sweep, the programs that train them, and their tables."""
