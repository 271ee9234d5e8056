"""The camera guidance: two calibrated cameras, a ball on the tool, and a servo on what they see (Liu 2007).

It speaks to devices (`twin.devices`); what is true of them only the plant knows.
"""
