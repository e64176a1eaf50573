"""Public names of recordings and the modules that define them."""

from .check import check_dataset as check_dataset
from .corrections import draft_corrections as draft_corrections
from .corrections import label_dataset as label_dataset
from .corrections import read_corrections as read_corrections
from .dataset import Dataset as Dataset
from .dataset import TrialInfo as TrialInfo
from .dataset import load_dataset as load_dataset
from .dataset import recover_dataset as recover_dataset
from .importing import import_recordings as import_recordings
from .labelling import Corrections as Corrections
from .labelling import Labelling as Labelling
from .options import LabelSettings as LabelSettings
from .options import ReadOptions as ReadOptions
from .splits import split_dataset as split_dataset
from .trial import ContactState as ContactState
from .trial import GroundTruth as GroundTruth
from .trial import Labels as Labels
from .trial import Recording as Recording
from .trial import TrialFacts as TrialFacts
