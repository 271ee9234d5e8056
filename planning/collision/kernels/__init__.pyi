from .hulls import Hulls as Hulls
from .proofs import Movers as Movers, ProofScene as ProofScene, SkinTree as SkinTree, scratch as scratch
from .segment_parts import CONTACT as CONTACT, NOT_FINITE as NOT_FINITE, QUERY as QUERY, Answer as Answer
from .surfaces import CELL_MM as CELL_MM
