from .bent_needle import bent_verdict as bent_verdict, with_bending as with_bending
from .insertion import Insertion as Insertion, insertion_along as insertion_along
from .path_layers import check_tissues as check_tissues, path_layers as path_layers
