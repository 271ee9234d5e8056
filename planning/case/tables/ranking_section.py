"""``[ranking]``: the weights of the cost."""

from __future__ import annotations

from typing import Self

from pydantic import model_validator

from puncture_twin.planning.case.toml_types import Section, Weight


class RankingSection(Section):
    """Weights of the cost terms; each term lies in 0..1, see planning/search/ranking.py."""

    clearance: Weight = 1.0
    path_length: Weight = 0.5
    skin_angle: Weight = 0.3
    tissue: Weight = 0.5
    reach: Weight = 0.5
    safe_cone: Weight = 0.5

    @model_validator(mode="after")
    def _one_counts(self) -> Self:
        if not any(getattr(self, name) > 0 for name in type(self).model_fields):
            raise ValueError("every weight is 0; one at least is above")
        return self
