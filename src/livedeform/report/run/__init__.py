"""The report of a run: ``read`` makes the evidence, ``charts`` and ``page`` show it."""
