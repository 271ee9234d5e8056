from .acquisition import Acquisition as Acquisition
from .acquisition import Shot as Shot
from .acquisition import acquire as acquire
from .acquisition import choice_noise as choice_noise
from .candidate_poses import Candidates as Candidates
from .candidate_poses import drawing as drawing
from .candidate_poses import find_candidates as find_candidates
from .puncture import (
    Puncture as Puncture,
)
from .puncture import (
    held_out_errors_mm as held_out_errors_mm,
)
from .puncture import (
    puncture_picture as puncture_picture,
)
from .puncture import (
    punctures as punctures,
)
from .selfcal_case import SelfcalCase as SelfcalCase
from .selfcal_case import load_selfcal_case as load_selfcal_case
from .selfcal_truth import draw_room as draw_room
from .simulate import SPEC_NOISE as SPEC_NOISE
from .simulate import Truth as Truth
from .simulate import simulate_recording as simulate_recording
from .summaries import (
    calibration_summary as calibration_summary,
)
from .summaries import (
    choice_summary as choice_summary,
)
from .summaries import (
    noise_summary as noise_summary,
)
from .summaries import (
    predicted_tre as predicted_tre,
)
from .summaries import (
    puncture_summary as puncture_summary,
)
from .summaries import (
    trial_summary as trial_summary,
)
from .trial import Choice as Choice
from .trial import Trial as Trial
from .two_arms import (
    TwoArms as TwoArms,
)
from .two_arms import (
    head_pose as head_pose,
)
from .two_arms import (
    needle_tool as needle_tool,
)
from .two_arms import (
    phantom_mesh as phantom_mesh,
)
from .two_arms import (
    probe_tool as probe_tool,
)
from .two_arms import (
    table_box as table_box,
)
