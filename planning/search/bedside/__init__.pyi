from .entry_facts import (
    EntryFacts as EntryFacts,
    NeedlePlanes as NeedlePlanes,
    entry_facts as entry_facts,
    needle_planes as needle_planes,
)
from .entry_place import EntryPlace as EntryPlace, Landmark as Landmark, entry_place as entry_place
