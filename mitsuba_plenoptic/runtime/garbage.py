"""Collections of garbage, which destroy no scene while Dr.Jit records or repeats a frozen function or traces symbols.

Dr.Jit 1.5 cannot record that the ray tracing kernel of a scene is released, which ends the process
("RecordThreadState::enqueue_host_func(): this function cannot be recorded"), and loses count of the objects in its
registry ("assign_with_registry(): The number of registry entries did not match"), with Mitsuba's sensors as with
ours. The scenes are earlier ones that notebooks, exceptions or circles of references still held. Python asks
`gc.callbacks` before each collection.
"""

import _thread
import gc
import sys
import threading
from typing import Any

import drjit as dr

_hidden = False


def hide_scenes(phase: str, info: dict[str, Any]) -> None:
    """Hide all objects from a collection of garbage, where Dr.Jit could not lose any; an entry of `gc.callbacks`."""
    global _hidden
    if phase == "start":
        _hidden = dr.flag(dr.JitFlag.SymbolicScope)
        frames = list(sys._current_frames().values())
        while frames and not _hidden:
            frame = frames.pop()
            # A call of a frozen function.
            _hidden = frame.f_globals is vars(dr) and frame.f_code.co_name == "__call__"
            frames += filter(None, [frame.f_back])
        # What a program has frozen stays so. It is asked last, as counting takes milliseconds for a million objects.
        _hidden = _hidden and not gc.get_freeze_count()
        if _hidden:
            gc.freeze()
    elif phase == "stop" and _hidden:
        gc.unfreeze()
        _hidden = False


def watch_collections() -> None:
    """Hide scenes from collections of garbage, and keep interrupts that fall into them.

    Python prints and forgets what callbacks raise, those of weak references, too: an interrupt comes again.
    """
    report = sys.unraisablehook

    def again(raised: Any) -> None:
        if issubclass(raised.exc_type, KeyboardInterrupt):
            threading.Timer(0.1, _thread.interrupt_main).start()
        else:
            report(raised)

    sys.unraisablehook = again
    gc.callbacks.append(hide_scenes)
