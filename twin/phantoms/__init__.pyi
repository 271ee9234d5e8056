from .chen2019_tables import TABLE_1 as TABLE_1, TABLE_2 as TABLE_2, TABLE_4 as TABLE_4, Point as Point
