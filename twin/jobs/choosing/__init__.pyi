from .comparison import Comparison as Comparison, Side as Side
