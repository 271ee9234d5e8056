"""Prove what lies between the grid points: certify a case, and let the plain checker prove every cell again.

python examples/05_verify_a_certificate.py [CASE] [CELL_SIZE_DEG]
"""

import sys

import puncture_twin as pt
from puncture_twin.meshes import folder


def main() -> None:
    """Certify, verify, and say how much of the cap is proven."""
    case = sys.argv[1] if len(sys.argv) > 1 else folder() / "carton" / "case_m.toml"
    size_deg = float(sys.argv[2]) if len(sys.argv) > 2 else 1.0
    context = pt.prepare(case, arm=False)
    certificate = pt.certify(context, size_deg=size_deg)
    done = pt.verify(certificate, context)
    for name, value in certificate.summary().items():
        print(f"{name}: {value}")
    print(f"verified: {done}")


if __name__ == "__main__":
    main()
