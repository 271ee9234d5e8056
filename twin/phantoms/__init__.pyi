from .chen2019_tables import TABLE_1 as TABLE_1
from .chen2019_tables import TABLE_2 as TABLE_2
from .chen2019_tables import TABLE_4 as TABLE_4
from .chen2019_tables import Point as Point
