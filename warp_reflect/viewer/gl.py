"""Whether this machine can draw with OpenGL, found out without VTK, which ends the process where it cannot."""

from __future__ import annotations

import ctypes
import os
import sys

ADVICE = "install a software OpenGL: Debian and Ubuntu `libegl1 libgl1-mesa-dri`, Fedora `mesa-libEGL mesa-dri-drivers`"
# EGL 1.5 and EGL_EXT_device_enumeration.
EGL_PLATFORM_SURFACELESS = 0x31DD
EGL_VENDOR = 0x3053


def library() -> str:
    """What off-screen drawing would use, such as "EGL (Mesa Project)"; empty: nothing was found."""
    if sys.platform in ("darwin", "win32"):
        return "the system's OpenGL"
    glx = bool(_load("libGL.so.1")) and has_display()
    return _egl() or _osmesa() or ("GLX" if glx else "")


def has_display() -> bool:
    """Whether a window can be opened."""
    return sys.platform in ("darwin", "win32") or bool(os.environ.get("DISPLAY"))


def off_screen_asked() -> bool:
    """Whether PYVISTA_OFF_SCREEN asks pyvista for no window."""
    return os.environ.get("PYVISTA_OFF_SCREEN", "").lower() == "true"


def _load(name: str):
    try:
        return ctypes.CDLL(name)
    except OSError:
        return None


def _osmesa() -> str:
    return next(("OSMesa" for name in ("libOSMesa.so.8", "libOSMesa.so") if _load(name)), "")


def _egl() -> str:
    egl = _load("libEGL.so.1")
    if egl is None:
        return ""
    egl.eglGetProcAddress.restype = ctypes.c_void_p
    egl.eglQueryString.restype = ctypes.c_char_p
    egl.eglQueryString.argtypes = [ctypes.c_void_p, ctypes.c_int]
    egl.eglInitialize.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p]
    address = egl.eglGetProcAddress(b"eglGetPlatformDisplayEXT")
    if not address:
        return ""
    kind = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_uint, ctypes.c_void_p, ctypes.c_void_p)
    display = kind(address)(EGL_PLATFORM_SURFACELESS, None, None)
    if display and egl.eglInitialize(display, None, None):
        vendor = egl.eglQueryString(display, EGL_VENDOR)
        return f"EGL ({vendor.decode() if vendor else 'unknown'})"
    # Drivers without Mesa's surfaceless platform list devices, which is how VTK finds them.
    address = egl.eglGetProcAddress(b"eglQueryDevicesEXT")
    count = ctypes.c_int(0)
    if address:
        ask = ctypes.CFUNCTYPE(ctypes.c_uint, ctypes.c_int, ctypes.c_void_p, ctypes.POINTER(ctypes.c_int))
        ask(address)(0, None, ctypes.byref(count))
    return f"EGL ({count.value} devices)" if count.value else ""
