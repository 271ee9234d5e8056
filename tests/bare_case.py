"""A case without files of its own: what a rehearsal needs of one, each field as a test would have it."""

from pathlib import Path

import numpy as np

from puncture_twin.planning.base.provenance import InputFiles
from puncture_twin.planning.case.case import Case, view_frame
from puncture_twin.planning.case.named_files import CaseVolumes
from puncture_twin.planning.case.settings import Needle, SearchSettings
from puncture_twin.planning.case.tables import RankingSection, RehearsalSection
from puncture_twin.planning.geometry.spaces import Space


def bare_case(target_ct, **fields):
    """A lesion at a target in a frame of its own; ``fields`` are those of `Case` that differ."""
    path = fields.get("path", Path("case.toml"))
    files = fields.get("files", InputFiles(Path()))
    usual = {
        "path": path,
        "name": "bare",
        "space": Space.LOCAL,
        "target_ct": target_ct,
        "target_name": "target",
        "target_structure": "lesion",
        "needle": Needle(210.0, 150.0, 1.2, 150.0, 10.0, 30.0),
        "search": SearchSettings((0, 1), (0, 6), 0.1, 1.0),
        "ranking": RankingSection(),
        "T_ct_entry": view_frame(np.eye(3), target_ct),
        "structure": (),
        "structures": (),
        "registration": None,
        "obstacles": (),
        "rehearsal": RehearsalSection(),
        "files": files,
        "volumes": CaseVolumes(files, path),
        "stated_structures": 1,
        "region": "other",
    }
    return Case(**usual | fields)
