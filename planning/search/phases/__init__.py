"""What the breath leaves of safe directions: organs and arm checked anew at every phase, if inserted at that phase.

It only takes away: no direction that is rejected where the CT shows the body becomes safe at another phase.
"""
