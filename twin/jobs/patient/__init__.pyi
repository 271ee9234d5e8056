from .place_job import place_case as place_case
