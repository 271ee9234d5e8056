from .draft import Draft as Draft
from .manifest import read_output as read_output
from .output_set import withdraw as withdraw, writing as writing
