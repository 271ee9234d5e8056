from .api import (
    certify as certify,
    check as check,
    load_case as load_case,
    make_plan as make_plan,
    prepare as prepare,
    read_certificate as read_certificate,
    read_plan as read_plan,
    read_points as read_points,
    register as register,
    rehearse as rehearse,
    rerank as rerank,
    search as search,
    verify as verify,
    write_plan as write_plan,
)
from .planning.base.errors import (
    InputError as InputError,
    NoAnswerError as NoAnswerError,
    PlanningError as PlanningError,
)
