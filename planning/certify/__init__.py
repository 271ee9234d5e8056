"""The map between the grid points: cells of directions that are proven safe or rejected, and the proof as a file."""

from puncture_twin.planning.certify.certificate import (
    Certificate,
    parse_certificate,
    read_certificate,
    write_certificate,
)
from puncture_twin.planning.certify.certify import certify
from puncture_twin.planning.certify.checker import Verification, verify
from puncture_twin.planning.certify.cone_column import with_safe_cone
from puncture_twin.planning.certify.question import Question

__all__ = [
    "Certificate",
    "Question",
    "Verification",
    "certify",
    "parse_certificate",
    "read_certificate",
    "verify",
    "with_safe_cone",
    "write_certificate",
]
