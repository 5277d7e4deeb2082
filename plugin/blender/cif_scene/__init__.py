"""CIF scenes in Blender: segmented, moving Gaussian splats, one object per instance.

`io` knows stages and needs no Blender; `blender` knows Blender. Only registering imports the latter, so that
the former can be used and tested anywhere.
"""


def register() -> None:
    """Add the menu entries and the panel."""
    from .blender import interface

    interface.register()


def unregister() -> None:
    """Take the menu entries and the panel away."""
    from .blender import interface

    interface.unregister()
