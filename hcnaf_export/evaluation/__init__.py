"""How good a forecast is: in nats, in probabilities kept, and in metres between its samples and the truth."""

from hcnaf_export.evaluation.calibrate import CALIBRATED as CALIBRATED
from hcnaf_export.evaluation.capabilities import Drawer as Drawer
from hcnaf_export.evaluation.capabilities import Mapper as Mapper
from hcnaf_export.evaluation.capabilities import Predictor as Predictor
from hcnaf_export.evaluation.capabilities import Sampler as Sampler
from hcnaf_export.evaluation.capabilities import Transformer as Transformer
from hcnaf_export.evaluation.checkpoint_predictor import CheckpointPredictor as CheckpointPredictor
from hcnaf_export.evaluation.evaluate import HORIZONS as HORIZONS
from hcnaf_export.evaluation.evaluate import SAMPLED as SAMPLED
from hcnaf_export.evaluation.evaluate import evaluate as evaluate
from hcnaf_export.evaluation.evaluate import evaluate_bundle as evaluate_bundle
from hcnaf_export.evaluation.evaluate import evaluate_checkpoint as evaluate_checkpoint
from hcnaf_export.evaluation.evaluate import evaluate_toy_checkpoint as evaluate_toy_checkpoint
from hcnaf_export.evaluation.extra_nats import ExtraNats as ExtraNats
from hcnaf_export.evaluation.paths import SampleScores as SampleScores
from hcnaf_export.evaluation.pit import PitScores as PitScores
from hcnaf_export.evaluation.predictors import BundlePredictor as BundlePredictor
from hcnaf_export.evaluation.regions import RegionScores as RegionScores
from hcnaf_export.evaluation.reliability import ReliabilityScores as ReliabilityScores
from hcnaf_export.evaluation.scores import Score as Score
from hcnaf_export.evaluation.scores import Scores as Scores
