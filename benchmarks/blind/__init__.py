"""The blind test: experiments with undeclared effects, diagnosed without a path to the truth, and judged against it."""
