from .manifest import read_output as read_output
from .output_set import Draft as Draft, withdraw as withdraw, writing as writing
