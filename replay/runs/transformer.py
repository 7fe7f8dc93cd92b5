"""Frozen modules as scikit-learn style transformers: all that is needed to use what was learned.

Neither the learner nor scikit-learn is needed for it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NoReturn, Self

import numpy as np
from numpy.typing import NDArray

from cdmisfa.core.errors import UsageError
from cdmisfa.core.modules import Module
from replay.runs.modules import load_modules


class SlowFeatures:
    """Slow features of frames, as a frozen module gives them.

    It comes fitted. In a pipeline that is to be fitted as a whole, put it into
    scikit-learn's `FrozenEstimator`.

    Args:
        module: the frozen module.

    Example:
        >>> module = Module(1, 0, 9, np.eye(1, 2), np.zeros(2), *[np.zeros(1)] * 3, np.zeros(1))
        >>> SlowFeatures(module).transform([[3.0, 4.0], [5.0, 6.0]]).ravel().tolist()
        [3.0, 5.0]
    """

    def __init__(self, module: Module) -> None:
        self.module = module

    @classmethod
    def load(cls, path: str | Path) -> tuple[Self, ...]:
        """A transformer for each module of modules.npz, or of a run's folder, in order.

        Raises:
            UsageError: there is no such file.
            LogDamagedError: it holds something else.
        """
        return tuple(cls(module) for module in load_modules(Path(path)))

    @property
    def components_(self) -> NDArray[np.float64]:
        """(J, I) weights, a row an output."""
        return self.module.phi

    @property
    def mean_(self) -> NDArray[np.float64]:
        """(I,) mean of the input, after scaling and expansion."""
        return self.module.mean

    def transform(self, X: Any) -> NDArray[np.float64]:
        """Outputs of the module on frames, y = phi (x - mean).

        Args:
            X: (n, I) values, or (n, height, width) pixels, of which uint8 count 1/255 each
                where it learned from pixels. They are expanded as they were for the learner.

        Returns:
            (n, J).

        Raises:
            UsageError: these are no frames as the module learned from.
        """
        return self.module.transform(X)

    def fit(self, X: Any = None, y: Any = None) -> NoReturn:
        """Refuse: a frozen module does not learn.

        Raises:
            UsageError: always.
        """
        raise UsageError(
            "a frozen module is not fitted again: learn a new one with cdmisfa learn, or put this "
            "one into sklearn.frozen.FrozenEstimator to keep it as it is in a pipeline"
        )

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """What it was made with, as scikit-learn asks for it."""
        return {"module": self.module}

    def set_params(self, **params: Any) -> Self:
        """Change what it was made with.

        Raises:
            UsageError: there is no such parameter.
        """
        if unknown := set(params) - {"module"}:
            raise UsageError(f"no parameter {', '.join(sorted(unknown))}: there is module")
        self.module = params.get("module", self.module)
        return self

    def __sklearn_is_fitted__(self) -> bool:
        return True

    def __sklearn_tags__(self) -> Any:
        from sklearn.utils import Tags, TargetTags, TransformerTags

        return Tags(
            estimator_type=None,
            target_tags=TargetTags(required=False),
            transformer_tags=TransformerTags(),
            requires_fit=False,
        )
