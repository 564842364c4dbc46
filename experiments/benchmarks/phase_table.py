"""The table that a benchmark prints."""

from typing import Any


def phase_table(measured: dict[str, Any]) -> str:
    """Format the figures of `measure` as a table."""
    per_1000 = measured["seconds_per_1000_steps"]
    whole = sum(per_1000.values())
    lines = [f"{'phase':<14}{'s / 1,000 steps':>16}{'share':>8}"]
    for name, seconds in per_1000.items():
        lines.append(f"{name:<14}{seconds:>16.3g}{seconds / whole:>8.1%}")
    lines.append(f"{'all of it':<14}{whole:>16.3g}{'100%':>8}")
    share = measured["share_of_peak"]
    lines += [
        f"{measured['steps_per_second']:,.1f} steps/s on {measured['device']}",
        f"compiling the update {measured['compile_seconds']:.0f} s, from the cache "
        f"{measured['compile_seconds_cached']:.1f} s, peak memory "
        f"{measured['peak_rss_mb']:,.0f} MB",
        f"matrix product {measured['matmul_gflops']:.0f} GFLOP/s"
        + (
            ""
            if share is None
            else f"; {measured['nominal_gflop_per_step']:.2g} GFLOP of nominal work a step: "
            f"{share:.2f} of that"
        ),
    ]
    if "phases_over_whole" in measured:
        lines.append(
            f"a whole iteration: {measured['whole_steps_per_second']:,.1f} steps/s; the phases' "
            f"sum is {measured['phases_over_whole']:.3f} of it"
        )
    if "of_the_slower" in measured:
        lines.append(
            f"collecting alone {measured['collecting_alone_seconds']:.3f} s, learning alone "
            f"{measured['learning_alone_seconds']:.3f} s, both at once "
            f"{measured['whole_seconds']:.3f} s: {measured['of_the_slower']:.2f} of the slower"
        )
    return "\n".join(lines)
