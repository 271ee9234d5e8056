"""The commands: each composes planning, plant, guidance and report. No algorithm lives here.

What a command, or a function of it, cannot use is refused by an `InputError`; an answer no may be a `NoAnswerError`.
"""
