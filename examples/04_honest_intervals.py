"""A thousand frames are not a thousand errors: the interval of an rmse, from frames that follow each other slowly."""

import numpy as np

from livedeform.compare_node.metrics import run_metrics
from livedeform.compare_node.residual import Residual

rng = np.random.default_rng(2)
ids = np.arange(20, dtype=np.uint32)
drift = np.cumsum(rng.normal(0.0, 1.0, 1000))
drift = 1e-3 * (drift - drift.mean()) / drift.std()  # an error that comes and goes slowly, 1 mm rms

residuals = []
for k, d in enumerate(drift):
    predicted = rng.normal(0.0, 0.03, (20, 3))
    measured = predicted + np.array([0.0, 0.0, d]) + rng.normal(0.0, 1e-4, (20, 3))
    residuals.append(Residual(k * 33_000_000, ids, measured, predicted, np.tile(1e-8 * np.eye(3), (20, 1, 1))))

metrics = run_metrics(residuals, threshold=0.005)
low, high = metrics.rmse.low, metrics.rmse.high
print(f"rmse {1e3 * metrics.rmse.value:.2f} mm, 95 %: {1e3 * low:.2f} to {1e3 * high:.2f} mm")
print(f"{metrics.n} errors in {metrics.n_frames} frames are worth {metrics.n_effective:.0f} independent frames")

naive = 2 * 1.96 * metrics.rmse.value / np.sqrt(2 * metrics.n)
assert metrics.n_effective < 100
assert high - low > 5 * naive  # what n independent errors would promise
