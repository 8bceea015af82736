"""How much pairs see through each other's surfaces, and which pair or pole is to blame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import erfc

from bodyscan.fusion.evidence import Evidence, Numbers
from bodyscan.fusion.smoothing import SmoothSurface
from bodyscan.fusion.thinning import Samples

Counts = NDArray[np.int64]
TINY_MM = 1e-6
MOST_OF_IT = 0.5
"""A group is blamed if less than this part of the share is left without it."""


@dataclass(frozen=True, eq=False)
class Contradictions:
    """How often pairs contradict each other's points.

    pairs: P of them.
    asked: how often the pair of the row said something about points of the column's, (P, P).
    against: how often it said that there is no surface, (P, P).
    by_noise: share of contradictions expected for a single surface, by the sigmas of both points.
    """

    pairs: tuple[str, ...]
    asked: Counts
    against: Counts
    by_noise: float = 0.0

    @staticmethod
    def of(
        pairs: Sequence[str],
        evidence: Sequence[Evidence],
        samples: Samples,
        surfaces: Sequence[SmoothSurface],
        agreement_mm: float,
    ) -> Contradictions:
        """Count what each pair's surface says about all samples; evidence: one for each pair."""
        starts = samples.starts

        def counted(index: Numbers) -> Counts:
            owner = np.searchsorted(starts, index, side="right") - 1
            return np.bincount(owner, minlength=len(pairs))

        against = np.array([counted(one.against_index) for one in evidence])
        agreed = np.array([counted(one.index) for one in evidence])
        sigma = np.concatenate(
            [
                np.hypot(samples.sigma_mm[index], surface.sigma_mm[at])
                for one, surface in zip(evidence, surfaces, strict=True)
                for index, at in ((one.index, one.at), (one.against_index, one.against_at))
            ]
        )
        beyond = erfc(agreement_mm / (np.sqrt(2.0) * np.maximum(sigma, TINY_MM)))
        by_noise = float(beyond.mean()) if len(beyond) else 0.0
        return Contradictions(tuple(pairs), agreed + against, against, by_noise)

    @property
    def share(self) -> float:
        """Share of contradictions in everything that pairs said about each other's points."""
        return float(self.against.sum() / max(self.asked.sum(), 1))

    @property
    def beyond_noise(self) -> float:
        """The share that noise does not explain."""
        return self.share - self.by_noise

    def blamed(self, groups: Mapping[str, frozenset[str]]) -> str:
        """The smallest of the groups without which the others agree best; "" if none stands out."""
        left = {name: self._without(group).share for name, group in groups.items()}
        fair = [
            name
            for name, group in groups.items()
            if len(self.pairs) > len(group) + 1 and left[name] < MOST_OF_IT * self.share
        ]
        least = min((left[name] for name in fair), default=0.0)
        # If a single pair is to blame, leaving it out is as good as leaving out its pole.
        near = [name for name in fair if left[name] <= least + 0.1 * (self.share - least)]
        return min(near, key=lambda name: (len(groups[name]), left[name]), default="")

    def _without(self, group: frozenset[str]) -> Contradictions:
        kept = np.flatnonzero([name not in group for name in self.pairs])
        some = np.ix_(kept, kept)
        names = tuple(self.pairs[k] for k in kept)
        return Contradictions(names, self.asked[some], self.against[some])
