from .manifest import read_output as read_output
from .output_set import Draft as Draft
from .output_set import withdraw as withdraw
from .output_set import writing as writing
