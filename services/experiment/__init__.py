"""The paper's experiment on concealed virtual robots: a plan, its cells, and what came of them."""
