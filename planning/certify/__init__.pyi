from .certificate import (
    MAX_CERTIFICATE_BYTES as MAX_CERTIFICATE_BYTES,
    Certificate as Certificate,
    parse_certificate as parse_certificate,
    write_certificate as write_certificate,
)
from .checker import verify as verify
from .cone_column import with_safe_cone as with_safe_cone
from .subdivision import certify as certify
