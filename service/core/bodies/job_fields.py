"""JSON Pointers of fields of a job that sweeps vary and tables name."""

SIGMA_PATH = "/noise/sigma"
METHOD_PATH = "/algorithm/method"
DATASETS_PATH = "/datasets"
WARM_START_PATH = "/warm_start"
