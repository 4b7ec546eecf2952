"""Several users served at once: beams of a codebook and precoders, by who knows what, on the true channel."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.beams.links import Ends
from warprrf.rf.channel.beams import select_beams, select_beams_multiuser, signal_over_interference
from warprrf.rf.channel.precoding import precoded_sinr, precoders, transmit_covariance
from warprrf.rf.paths.path_set import Paths

USERS = (2, 4, 8, 16)
CHOICES = {
    "alone": "each user's own best beam",
    "together": "beams minding interference",
    "mr": "maximum ratio",
    "zf": "zero forcing",
    "slnr": "SLNR",
}
"""How users are served, in the order of the tables."""
KNOWN = "channel"
"""Precoders that know the true channel: of each pair of antennas, over the band."""
UNKNOWN = 1e-30  # mean gain of any direction for a user of whom nothing is predicted

Key = tuple[str, int | None]


def several_users(
    e: Ends,
    channels: Sequence[np.ndarray],
    worth: Sequence[np.ndarray],
    guesses: Sequence[dict[Key, Paths]],
    noise: float,
    seed: int,
    counts: Sequence[int] = USERS,
) -> list[dict[str, Any]]:
    """Sum spectral efficiency of random groups of users, each served once; gains are means over the band.

    Args:
        e: One transmitting array and a single receiving element.
        channels: True channel of each receiver, shape ``(F, 1, N)``.
        worth: Its mean gain for every pair of beams, shape ``(1, Bt)``.
        guesses: Its paths as each method predicts them.
        noise: Noise power over the transmitted power.
        seed: Of the groups.
        counts: Users at once; those that there are not enough receivers for are left out.
    """
    order = np.random.default_rng(seed).permutation(len(channels))
    h = np.stack([c[:, 0] for c in channels])
    true = np.einsum("ufn,ufm->unm", h.conj(), h) / h.shape[1]
    found = []
    for key in [*guesses[0], (KNOWN, None)]:
        if key[0] == KNOWN:
            known, seen = true, None
        else:
            seen = [g[key] for g in guesses]
            known = transmit_covariance(seen, e.tx) + UNKNOWN * np.eye(e.tx.elements)
        for users in (n for n in counts if n <= len(channels)):
            groups = [order[k : k + users] for k in range(0, len(order) - users + 1, users)]
            sums: dict[str, list[float]] = {}
            for group in groups:
                served = {m: precoders(known[group], m, noise=noise) for m in ("mr", "zf", "slnr")}
                sinr = {m: precoded_sinr(true[group], w, noise=noise) for m, w in served.items()}
                if seen is not None:
                    sinr |= _beams(e, [seen[u] for u in group], [worth[u] for u in group], noise)
                for how, values in sinr.items():
                    sums.setdefault(how, []).append(float(np.log2(1.0 + values).sum()))
            found += [
                {"ends": e.name, "users": users, "groups": len(groups), "method": key[0], "n_train": key[1],
                 "choice": how, "efficiency": float(np.mean(sums[how]))}
                for how in CHOICES if how in sums
            ]  # fmt: skip
    return found


def _beams(e: Ends, seen: list[Paths], worth: list[np.ndarray], noise: float) -> dict[str, np.ndarray]:
    """SINR of a group with a beam for each user, chosen alone or together."""
    alone = [select_beams(p, e.tx_book, e.rx_book) for p in seen]
    together = select_beams_multiuser(seen, e.tx_book, e.rx_book, noise=noise)
    return {
        "alone": signal_over_interference(worth, [c.tx[0] for c in alone], [c.rx[0] for c in alone], noise),
        "together": signal_over_interference(worth, together.tx, together.rx, noise),
    }


def table(rows: Sequence[dict[str, Any]], names: dict[str, str]) -> list[str]:
    """Markdown tables, one for each number of users."""
    lines: list[str] = []
    for users in dict.fromkeys(r["users"] for r in rows):
        own = [r for r in rows if r["users"] == users]
        sums = {(r["method"], r["n_train"], r["choice"]): r["efficiency"] for r in own}
        lines += ["", f"### {users} users at once, {own[0]['ends']} elements", ""]
        lines += [f"Sum spectral efficiency [bit/s/Hz], mean of {own[0]['groups']} groups.", ""]
        lines += [
            f"| method | spectra | {' | '.join(CHOICES.values())} |",
            "|---|---|" + "---|" * len(CHOICES),
        ]
        for method, count in dict.fromkeys((m, n) for m, n, _ in sums):
            values = [sums.get((method, count, how)) for how in CHOICES]
            cells = " | ".join("-" if v is None else f"{v:.2f}" for v in values)
            lines.append(f"| {names[method]} | {count or '-'} | {cells} |")
    return lines
