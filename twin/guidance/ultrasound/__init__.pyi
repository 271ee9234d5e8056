from .acquisition import (
    Acquisition as Acquisition,
    ProbeShot as ProbeShot,
    acquire as acquire,
    choice_noise as choice_noise,
)
from .candidate_poses import CandidatePoses as CandidatePoses, drawing as drawing, find_candidates as find_candidates
from .pose_choice import choose_poses as choose_poses, expected_tre_mm as expected_tre_mm
from .puncture import (
    Puncture as Puncture,
    puncture_picture as puncture_picture,
    punctures as punctures,
    unseen_errors_mm as unseen_errors_mm,
)
from .recording_file import (
    FILE_NAME as FILE_NAME,
    MAX_BYTES as MAX_BYTES,
    parse_recording as parse_recording,
    recording_file as recording_file,
    write_recording as write_recording,
)
from .selfcal_case import SelfcalCase as SelfcalCase, load_selfcal_case as load_selfcal_case
from .simulate import (
    SPEC_NOISE as SPEC_NOISE,
    SimulatedTruth as SimulatedTruth,
    simulate_recording as simulate_recording,
)
from .slips import checked_calibration as checked_calibration
from .summaries import (
    calibration_summary as calibration_summary,
    choice_summary as choice_summary,
    noise_summary as noise_summary,
    predicted_tre as predicted_tre,
    puncture_summary as puncture_summary,
    trial_summary as trial_summary,
)
from .trial import Choice as Choice, SelfcalTrial as SelfcalTrial
from .two_arms import (
    TwoArms as TwoArms,
    head_pose as head_pose,
    needle_tool as needle_tool,
    phantom_mesh as phantom_mesh,
    probe_tool as probe_tool,
    table_box as table_box,
)
