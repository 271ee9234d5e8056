from .chain import Chain as Chain, chain_of as chain_of
from .what_if import Change as Change, SourceCost as SourceCost, changes as changes, source_costs as source_costs
