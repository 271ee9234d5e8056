"""An output folder as one set with a manifest: written beside the old set, then renamed in; no kill leaves a mix.

What the files hold is the business of the command that writes them.
"""
