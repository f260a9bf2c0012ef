"""The tables of docs/forces.md."""

from __future__ import annotations

from force_cases import ABSCISSAE, FORCES, SECTIONS, TARES, Results, case


def payload_table(results: Results) -> str:
    """Markdown."""
    lines = [
        "| rest lengths | from | as it is (g) | worst | bias | stated deviation | tare at the posture (g) | worst "
        "| one constant tare (g) | worst |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for controller, by_estimator in results.items():
        for name, r in by_estimator.items():
            cells = [f"{r[key]:.1f}" for key in ("raw_mean_g", "raw_worst_g", "raw_bias_g", "deviation_g",
                     "posture_mean_g", "posture_worst_g", "constant_mean_g", "constant_worst_g")]  # fmt: skip
            lines.append("| " + " | ".join([controller, name, *cells]) + " |")
    return "\n".join(lines)


def contact_table(results: Results) -> str:
    """Markdown."""
    cells_of = ("located", "covered", "place (cm)", "force (N)", "(deg)", "known place (N)")
    heads = [f"{size:g} N: {what}" for size in FORCES for what in cells_of]
    lines = ["| model | place | tare | " + " | ".join(heads) + " |", "|" + "---|" * (3 + len(heads))]
    for model, by_case in results.items():
        for section in SECTIONS:
            for how in TARES:
                cells = []
                for size in FORCES:
                    r = by_case[case(section, size, how)]
                    cells += [f"{100 * r[share]:.0f} %" for share in ("located", "covered")]
                    cells += [f"{r['place_mean_cm']:.1f}", f"{r['force_n']:.2f}"]
                    cells += [f"{r['angle_deg']:.0f}", f"{r['known_force_n']:.2f}"]
                lines.append("| " + " | ".join([model, f"{ABSCISSAE[section]:g} m", how, *cells]) + " |")
    return "\n".join(lines)


def motion_table(results: Results) -> str:
    """Markdown."""
    lines = [
        "| signal | force (N) | seen | after (s), median | longest | false alarms |",
        "|---|---|---|---|---|---|",
    ]
    for signal, by_force in results.items():
        for force, r in by_force.items():
            seen, alarms = (f"{100 * r[share]:.0f} %" for share in ("seen", "alarms"))
            cells = [seen, f"{r['median_s']:.2f}", f"{r['longest_s']:.2f}", alarms]
            lines.append("| " + " | ".join([signal, force, *cells]) + " |")
    return "\n".join(lines)


def cost_table(results: dict[str, float]) -> str:
    """Markdown."""
    rows = [f"| {name} | {value:.0f} |" for name, value in results.items()]
    return "\n".join(["| one arm | us |", "|---|---|", *rows])


TABLES = {"payloads": payload_table, "contacts": contact_table, "motion": motion_table, "cost": cost_table}
