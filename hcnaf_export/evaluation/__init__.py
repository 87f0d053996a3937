"""How good a forecast is: in nats, and in metres between its samples and the truth."""

from hcnaf_export.evaluation.evaluate import HORIZONS as HORIZONS
from hcnaf_export.evaluation.evaluate import SAMPLED as SAMPLED
from hcnaf_export.evaluation.evaluate import evaluate as evaluate
from hcnaf_export.evaluation.evaluate import evaluate_bundle as evaluate_bundle
from hcnaf_export.evaluation.evaluate import evaluate_checkpoint as evaluate_checkpoint
from hcnaf_export.evaluation.evaluate import evaluate_toy_checkpoint as evaluate_toy_checkpoint
from hcnaf_export.evaluation.paths import SampleScores as SampleScores
from hcnaf_export.evaluation.predictors import BundlePredictor as BundlePredictor
from hcnaf_export.evaluation.predictors import CheckpointPredictor as CheckpointPredictor
from hcnaf_export.evaluation.predictors import Predictor as Predictor
from hcnaf_export.evaluation.scores import Score as Score
from hcnaf_export.evaluation.scores import Scores as Scores
