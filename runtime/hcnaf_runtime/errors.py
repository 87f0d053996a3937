"""Every error this distribution raises on purpose.

    HcnafError
    ├── InputError        what was given cannot be used (commands exit with 2)
    │   ├── SceneError        a scene: file, field, dtype, shape or value
    │   ├── BundleError       a bundle: missing, altered or of an unknown format
    │   ├── HorizonError      a horizon outside the range the model was trained on
    │   ├── GridError         a grid that cannot be laid out
    │   ├── CheckpointError   a checkpoint that is not ours
    │   ├── RecipeError       a training recipe with an unknown or impossible setting
    │   ├── DataError         a data set or recording that cannot be read
    │   └── MissingExtraError an optional dependency that is not installed
    └── FailedError       what was asked for was tried and failed (commands exit with 1)
        ├── ParityError       an exported graph does not agree with PyTorch
        ├── VerifyError       a bundle does not reproduce its golden outputs
        ├── TrainingError     training diverged
        └── ReproductionError a reproduced figure is worse than its bound

Messages are one line: what was found, what was expected, what to do.
"""


class HcnafError(Exception):
    """Base of all errors raised on purpose."""


class InputError(HcnafError):
    """What was given cannot be used."""


class SceneError(InputError):
    """A scene with a bad file, field, dtype, shape or value."""


class BundleError(InputError):
    """A bundle that is missing, altered or of an unknown format."""


class HorizonError(InputError):
    """A horizon outside the range the model was trained on."""


class GridError(InputError):
    """A grid that cannot be laid out."""


class CheckpointError(InputError):
    """A checkpoint that is not ours."""


class RecipeError(InputError):
    """A training recipe with an unknown or impossible setting."""


class DataError(InputError):
    """A data set or recording that cannot be read."""


class MissingExtraError(InputError):
    """An optional dependency that is not installed."""


class FailedError(HcnafError):
    """What was asked for was tried and failed."""


class ParityError(FailedError):
    """An exported graph does not agree with PyTorch."""


class VerifyError(FailedError):
    """A bundle does not reproduce its golden outputs."""


class TrainingError(FailedError):
    """Training diverged."""


class ReproductionError(FailedError):
    """A reproduced figure is worse than its bound."""
