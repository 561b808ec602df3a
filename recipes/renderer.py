"""Imported before TorchRL, which imports MuJoCo, which loads the renderer that MUJOCO_GL names.

Where that renderer is missing, the import fails with a traceback that does not say so.
"""

from __future__ import annotations

import os

try:
    import mujoco  # noqa: F401
except ImportError:
    pass  # what needs MuJoCo says so itself
except Exception as error:  # each renderer has exceptions of its own
    raise SystemExit(
        f"error: MuJoCo cannot be loaded with MUJOCO_GL={os.environ.get('MUJOCO_GL')!r} ({error}); "
        "expected a renderer that is installed. Unset MUJOCO_GL, or install the library: libOSMesa "
        "for osmesa, libEGL for egl."
    ) from None
