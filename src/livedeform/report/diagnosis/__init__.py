"""The report of a diagnosis: ``collect`` makes the evidence, ``charts``, ``tables`` and ``page`` show it."""
