"""Payloads and contacts: `python benchmarks/forces.py` writes forces.json and the tables of docs/forces.md.

Section V-B's arm, six sections, seen by three noisy sensors (0.2 mm, 0.5 degrees) and by tension sensors (0.05 N); the
estimators know its material and take it for three sections, or nine. Payloads at the end of the thirty runs, contacts
at rest, and contacts that begin in motion. Three minutes, and as much once more for machine code the first time.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import torch
from force_cases import (
    ABSCISSAE,
    CONTROLLERS,
    FORCES,
    SECTIONS,
    TARES,
    D,
    Results,
    Seen,
    affine,
    arrived,
    balance,
    case,
    finer,
    held,
    posture,
    settings,
)
from force_cost import costs
from force_motion import detections
from force_tables import TABLES
from page import between
from torch import Tensor
from tqdm import tqdm

from apcc_torch.composition.build import Builder
from apcc_torch.estimation.contact import ContactSearch
from apcc_torch.estimation.external_force import ForceBalance, Tare
from apcc_torch.estimation.posture import Posture
from apcc_torch.files import write_atomically, write_json
from apcc_torch.model.backbone import PCCBackbone

KNOWN_WEIGHT = 0.25  # kg
MARKS = {part: (f"<!-- {part}: python benchmarks/forces.py -->", f"<!-- end of {part} -->")
         for part in TABLES}  # fmt: skip


def _summary(mass: Tensor, payload: Tensor) -> dict[str, float]:
    """Errors in g over rows."""
    error = 1e3 * (mass - payload)
    return {"mean_g": float(error.abs().mean()), "worst_g": float(error.abs().max()), "bias_g": float(error.mean())}


def _columns(estimates: dict[str, Tensor], payload: Tensor) -> dict[str, float]:
    """As it is over all rows; with the two tares over the loaded rows."""
    loaded = payload > 0
    found = {}
    for name, mass in estimates.items():
        rows = torch.ones_like(loaded) if name == "raw" else loaded
        found |= {f"{name}_{key}": value for key, value in _summary(mass[rows], payload[rows]).items()}
    return found


def _model_error(b: ForceBalance, like: Tensor) -> Tensor:
    """The covariance that `BalanceNoise` states for the model."""
    model = b.body.backbone.coordinates.per_unit(b.bend_noise, b.length_noise, like.shape[-1], like)
    return torch.diag_embed(model * model)


def _balanced(b: ForceBalance, p: Posture, payload: Tensor) -> dict[str, float]:
    """Payload by the balance; rows are set-points by payloads, the payload fastest, the first of them none."""
    r = b.imbalance(p)
    empty = r.unflatten(0, (10, -1))[:, :1]
    spread = _model_error(b, p.q_bar)
    here = empty.expand(10, len(r) // 10, -1).flatten(0, 1)
    training = empty[::2, 0].mean(0)
    raw = b.payload(p)
    estimates = {
        "raw": raw.value[:, 0],
        "posture": b.payload(p, Tare(here, spread)).value[:, 0],
        "constant": b.payload(p, Tare(training, spread)).value[:, 0],
    }
    return _columns(estimates, payload) | {"deviation_g": 1e3 * float(raw.deviation.mean())}


def _held(build: Builder, seen: Seen, own: bool) -> dict[str, dict[str, float]]:
    """Payload by the finer model under known tendon lengths, from the shape, the tensions, and both."""
    h = finer(build, own)
    u = seen.u.expand(len(seen.T), *seen.u.shape)
    masses, results = {}, {}
    for name, given in {"shape": (seen.T, None), "tensions": (None, u), "both": (seen.T, u)}.items():
        found = h(seen.y.expand_as(u), *given)
        masses[name] = found.load.value[..., 0].mean(0)
        results[name] = {"deviation_g": 1e3 * float(found.load.deviation.mean())}
    # Weighed by how wrong each is where nothing hangs, on the way to half of the set-points.
    known = {name: masses[name].unflatten(0, (10, -1))[::2, 0].square().mean() for name in ("shape", "tensions")}
    total = sum(1.0 / v for v in known.values())
    masses["both, weighed by their errors unloaded"] = sum(masses[name] / v for name, v in known.items()) / total
    results["both, weighed by their errors unloaded"] = {"deviation_g": 1e3 * float(total**-0.5)}
    sections = "the arm's own 6" if own else "9"
    for name, mass in masses.items():
        empty = mass.unflatten(0, (10, -1))[:, :1]
        tares = {"posture": (mass.unflatten(0, (10, -1)) - empty).flatten(), "constant": mass - empty[::2].mean()}
        results[name] |= _columns({"raw": mass} | tares, seen.payload)
    return {f"tendon lengths, {sections} sections: {name}": r for name, r in results.items()}


def payloads(compile: str) -> tuple[Results, Seen]:
    """Payload errors at the end of the runs of section V-B, by controller and estimator."""
    results: Results = {}
    first = None
    for controller in tqdm(CONTROLLERS, desc="payloads"):
        generator = torch.Generator().manual_seed(1)
        seen = arrived(controller, compile, generator)
        build = Builder(settings(*CONTROLLERS[controller]))
        pcc, aff = balance(build, build.backbone()), balance(build, affine(build))
        fixed = build.rest_lengths()
        in_loop = Posture(seen.q_bar, seen.pi_hat, seen.u, seen.qdot)
        found = {"tensions and q_bar, constant curvature": _balanced(pcc, in_loop, seen.payload)}
        if first is None:
            first = seen
            inferred = posture(aff, seen.T, seen.u, fixed)
            found["tensions and q_bar, affine curvature"] = _balanced(aff, inferred, seen.payload)
            stiff = balance(build, affine(build), stiffer=1.05)
            found["the same, taken for 5 % stiffer"] = _balanced(stiff, inferred, seen.payload)
            pulled = inferred._replace(u=1.02 * seen.u)
            found["the same, tensions read 2 % too large"] = _balanced(aff, pulled, seen.payload)
            found["q_bar alone, affine curvature"] = _balanced(aff, inferred._replace(u=None), seen.payload)
            found |= _held(build, seen, own=False) | _held(build, seen, own=True)
        results[controller] = found
    assert first is not None  # there are controllers
    return results, first


def _touches(rows: int, size: float, section: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Forces (R, 3) of one size in random directions, and the arm's section wrenches (R, 6, 6)."""
    f = torch.randn(rows, 3, dtype=D, generator=generator)
    f = size * f / f.norm(dim=-1, keepdim=True)
    touch = torch.zeros(rows, 6, 6, dtype=D)
    touch[:, section, 3:] = f
    return f, touch


def _tared_error(build: Builder, b: ForceBalance, y: Tensor, start: Tensor) -> Tensor:
    """Covariance (n, n) of what a tare leaves, measured with a known weight at the tip in half of the postures."""
    generator = torch.Generator().manual_seed(3)
    weight = torch.zeros(5, 6, 6, dtype=D)
    pi = build.rest_lengths()
    empty = b.imbalance(posture(b, *held(build, y[::2], start, weight, generator), pi))
    weight[:, -1, 5] = -9.81 * KNOWN_WEIGHT
    p = posture(b, *held(build, y[::2], start, weight, generator), pi)
    left = b.imbalance(p._replace(payload=torch.full((5,), KNOWN_WEIGHT, dtype=D))) - empty
    coordinates = b.body.backbone.coordinates
    angles, lengths = (coordinates.of_pattern(left)[..., part].square().mean().sqrt() for part in
                       (coordinates.angular, coordinates.linear))  # fmt: skip
    return torch.diag(coordinates.per_unit(angles, lengths, left.shape[-1], left) ** 2)


def contacts(seen: Seen) -> Results:
    """Errors of a contact's force and place at rest, by model and by place and size."""
    build = Builder(settings(*CONTROLLERS["fixed"]))
    y = seen.y.unflatten(0, (10, -1))[:, 0]
    start = torch.zeros(18, dtype=D)
    pi = build.rest_lengths()
    models = {"constant curvature": balance(build, PCCBackbone(3, build.base_rotation())),
              "affine curvature": balance(build, affine(build))}  # fmt: skip
    results: Results = {name: {} for name in models}
    free = held(build, y, start, torch.zeros(10, 6, 6, dtype=D), torch.Generator().manual_seed(2))
    spreads = {name: _tared_error(build, b, y, start) for name, b in models.items()}
    tasks = [(section, size) for section in SECTIONS for size in FORCES]
    for section, size in tqdm(tasks, desc="contacts"):
        generator = torch.Generator().manual_seed(100 * section + int(10 * size))
        f, touch = _touches(10, size, section, generator)
        T, u = held(build, y, start, touch, generator)
        for name, b in models.items():
            unloaded = b.imbalance(posture(b, *free, pi))
            p = posture(b, T, u, pi)
            tared = Tare(unloaded, spreads[name])
            for how, t in zip(TARES, (None, tared), strict=True):
                found = ContactSearch(b)(p, t)
                known = b.force(p, torch.tensor([ABSCISSAE[section]], dtype=D), t)
                results[name][case(section, size, how)] = {
                    "located": float(found.located.double().mean()),
                    "place_mean_cm": 1e2 * float((found.abscissa - ABSCISSAE[section]).abs().mean()),
                    "place_worst_cm": 1e2 * float((found.abscissa - ABSCISSAE[section]).abs().max()),
                    "force_n": float((found.estimate.value - f).norm(dim=-1).mean()),
                    "angle_deg": _angle(found.estimate.value, f),
                    "known_force_n": float((known.value - f).norm(dim=-1).mean()),
                    "known_angle_deg": _angle(known.value, f),
                    "covered": float(((found.interval - ABSCISSAE[section]).prod(-1) <= 0.0).double().mean()),
                    "gain": float(found.gain.mean()),
                }
    return results


def _angle(a: Tensor, b: Tensor) -> float:
    """Mean angle between directions, degrees."""
    return float(torch.rad2deg(torch.atan2(torch.linalg.cross(a, b).norm(dim=-1), (a * b).sum(-1))).mean())


def main() -> None:
    """Runs all parts, or writes the tables again from their numbers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default="forces.json", help="where the numbers go (default: %(default)s)")
    parser.add_argument("--page", default="docs/forces.md", help="the page with the tables (default: %(default)s)")
    parser.add_argument("--compile", default="aot", help="how the runs are stepped: off, aot (default: %(default)s)")
    parser.add_argument("--table", action="store_true", help="only write the tables, from the file of --out")
    options = parser.parse_args()
    torch.set_num_threads(1)
    if options.table:
        results = json.loads(Path(options.out).read_text(encoding="utf-8"))
    else:
        with torch.inference_mode(False), torch.no_grad():
            by_payload, seen = payloads(options.compile)
            results = {
                "payloads": by_payload,
                "contacts": contacts(seen),
                "motion": detections(options.compile),
                "cost": costs(seen),
            }
        write_json(options.out, results)
    page = Path(options.page)
    text = page.read_text(encoding="utf-8")
    for part, table in TABLES.items():
        text = between(text, *MARKS[part], table(results[part]))
    write_atomically(page, text)


if __name__ == "__main__":
    main()
