from .entry_facts import EntryFacts as EntryFacts, entry_facts as entry_facts
from .entry_place import EntryPlace as EntryPlace, Landmark as Landmark, entry_place as entry_place
from .needle_planes import NeedlePlanes as NeedlePlanes, needle_planes as needle_planes
