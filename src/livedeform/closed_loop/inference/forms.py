"""Number an effect in another form, from where a body that swings goes on swinging as it does.

Fitted from anywhere else, a form that stiffens or damps otherwise ends where it is switched off: the wrong frequency is
out of phase after some swings, and nothing is better than nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from livedeform.closed_loop.candidates import Candidate
from livedeform.closed_loop.evidence.observation import Observation
from livedeform.closed_loop.inference.fitted_model import Added, FittedModel

RATES = 2000  # that are tried, from one turn in the whole recording to one in two steps of time


def in_form(
    model: FittedModel, number: int, form: Candidate, known: Mapping[str, Candidate], rate: float
) -> FittedModel:
    """Return the ``model`` with the added effect ``number`` in another form, yet to be fitted, and with what the form
    asks for among the ``known`` candidates; ``rate`` rad/s: of the swing, 0 where nothing swings."""
    alike = form.form.alike if form.form is not None else None
    if alike is None or rate <= 0.0:
        added = list(model.added)
        added[number] = Added(form, form.beginning)
        return replace(model, added=tuple(added))
    values = alike({a.candidate.name: a.values.values for a in model.added}, rate)
    of_name = {a.candidate.name: form if i == number else a.candidate for i, a in enumerate(model.added)}
    of_name |= {name: known[name] for name in values if name not in of_name and name in known}
    places = {a.candidate.name: a.z for a in model.added}
    places |= {name: of_name[name].coordinates_of(v) for name, v in values.items() if name in of_name}
    return replace(model, added=tuple(Added(c, places[name]) for name, c in of_name.items()))


def of_itself(candidate: Candidate) -> list[Candidate]:
    """Return the forms that number an effect by itself: not that of all that a release shows together."""
    return [f for f in candidate.forms if f.form is None or f.form.released is None]


def as_released(
    model: FittedModel, known: Mapping[str, Candidate], rate: float, most: float = np.inf
) -> FittedModel | None:
    """Return, yet to be fitted, all that a body which was let go shows together, as a form of an effect in the
    ``model`` says, of what is among the ``known`` candidates, if need be without what can be spared of it so that they
    are at ``most`` so many; None if no form does, nothing swings, or it is all in the model. What else is there may
    have stood in for it, and is left out."""
    rings = [a for a in model.added if a.candidate.info.rings]
    for added in model.added:
        form = next((f for f in known[added.candidate.name].forms if f.form is not None and f.form.released), None)
        if form is None or form.form is None or form.form.released is None or not rings or rate <= 0.0:
            continue
        values = form.form.released({a.candidate.name: a.values.values for a in model.added}, rate)
        of_name = {name: known[name] for name in (*model.names, *values) if name in values and name in known}
        of_name[form.name] = form
        places = {name: c.coordinates_of(values[name]) if values[name] else c.beginning for name, c in of_name.items()}
        placed = [Added(c, places[name]) for name, c in of_name.items()]
        placed += [a for a in rings if a.candidate.name not in of_name]
        for name in reversed(form.form.spare):
            if len(placed) > most:
                placed = [a for a in placed if a.candidate.name != name]
        now = {a.candidate.name: a.candidate.form for a in model.added}
        alike = {a.candidate.name: a.candidate.form for a in placed}.items() <= now.items()
        return None if alike else replace(model, added=tuple(placed), joint=None)
    return None


def swing_rate(observations: Sequence[Observation]) -> float:
    """Return the rate in rad/s at which the markers of the recording that moves fastest swing; 0 where none moves."""
    from scipy.signal import lombscargle  # half a second, for bodies that swing only

    fastest = max(observations, key=lambda o: float(np.nansum(np.nan_to_num(o.rates) ** 2)))
    speeds = np.nan_to_num(fastest.rates).reshape(fastest.n_moments, -1)
    seconds = fastest.seconds
    steps = np.diff(seconds)
    if len(seconds) < 3 or not speeds.any() or not (steps > 0.0).all():
        return 0.0
    u, s, _ = np.linalg.svd(speeds, full_matrices=False)
    rates = np.linspace(2.0 * np.pi / np.ptp(seconds), np.pi / steps.min(), RATES)
    return float(rates[np.argmax(lombscargle(seconds, u[:, 0] * s[0], rates))])
