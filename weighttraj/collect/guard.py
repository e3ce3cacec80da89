"""Notices that an exception ends a training, which Stable-Baselines3 tells no callback."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CallbackList

_METHODS = ("collect_rollouts", "train", "dump_logs", "_do_one_update")
"""What ``learn`` calls again and again, in one algorithm or another."""
_FIRST, _LAST = "on_training_start", "on_training_end"
"""What it calls of its callbacks first and last."""
_EXCLUDED = "_excluded_save_params"


class Guard:
    """Calls back when an exception leaves one of the methods that ``learn`` consists of.

    That includes ``KeyboardInterrupt`` and ``SystemExit``; the exception goes on. Meanwhile the
    methods are wrapped on the model itself, not on its class. The wrappers are left out of what
    ``model.save`` stores, and a copy of the model has its own methods.

    Args:
        model: whose training.
        on_exception: what to do. An error that it raises is noted on the exception.
        callback: what ``learn`` calls back. The end of the training is watched too, and its
            beginning for those in a list that have not been told of it yet.
        on_refusal: what to do if one of these refuses the training.
    """

    def __init__(
        self,
        model: BaseAlgorithm,
        on_exception: Callable[[], None],
        callback: BaseCallback | None,
        on_refusal: Callable[[], None],
    ) -> None:
        self._wrappers: list[_Wrapper] = []
        names = [name for name in _METHODS if hasattr(model, name)]
        for name in names:
            self._wrappers.append(_Guarded(model, name, on_exception))
        self._wrappers.append(_Exclusion(model, [*names, _EXCLUDED]))
        if callback is not None:
            self._wrappers.append(_Guarded(callback, _LAST, on_exception))
        if isinstance(callback, CallbackList):
            self._wrappers += [_Guarded(x, _FIRST, on_refusal) for x in callback.callbacks]

    def remove(self) -> None:
        """Give the model its own methods back. A second call does nothing."""
        for wrapper in self._wrappers:
            wrapper.remove()


class _Wrapper:
    """Stands in a method's place on one object; copies and pickles give the method itself."""

    def __init__(self, owner: Any, name: str) -> None:
        self._owner, self._name = owner, name
        self._method = getattr(owner, name)
        self._before = vars(owner).get(name)
        self._active = True
        vars(owner)[name] = self

    def remove(self) -> None:
        """Put back what was there before; another's wrapper that came later stays."""
        self._active = False
        current = vars(self._owner).get(self._name)
        while isinstance(current, _Wrapper) and not current._active:
            current = current._before
        if current is None:
            vars(self._owner).pop(self._name, None)
        else:
            vars(self._owner)[self._name] = current

    def __reduce__(self) -> tuple[Any, ...]:
        return getattr, (self._owner, self._name)  # of the copy, which has no wrapper yet


class _Guarded(_Wrapper):
    def __init__(self, owner: Any, name: str, on_exception: Callable[[], None]) -> None:
        super().__init__(owner, name)
        self._on_exception = on_exception

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        try:
            return self._method(*args, **kwargs)
        except BaseException as error:
            try:
                self._on_exception()
            except Exception as failure:
                error.add_note(f"and its trajectory could not be committed: {failure}")
            raise


class _Exclusion(_Wrapper):
    def __init__(self, model: BaseAlgorithm, names: list[str]) -> None:
        super().__init__(model, _EXCLUDED)
        self._names = names

    def __call__(self) -> list[str]:
        return [*self._method(), *self._names]
