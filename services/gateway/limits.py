"""How much may be asked of a study: numbers alone, for whoever plans studies without a gateway."""

TRIALS = 1000
"""The most, uniform ones among them."""
REPEATS = 100
"""The most walks of an eta that was chosen."""
HORIZON = 600
"""The longest walk, s."""
SEEDS = 2**31
"""Below which seeds are."""
ETAS = 4096
"""The most of simulated rollouts."""
