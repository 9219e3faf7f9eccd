"""What every test shares: where Warp may write, and which devices there are."""

import pytest
import warp as wp

try:
    from xdist.scheduler import LoadFileScheduling
except ImportError:  # without -n there is nothing to schedule
    LoadFileScheduling = None

#: Folders whose files share their kernels: one worker has them all.
TOGETHER = ("tests/accuracy/",)


def _has_cuda() -> bool:
    return wp.get_cuda_device_count() > 0


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--device", default="cpu", help="where scenes live whose test names no device, cuda:0 say")


def pytest_configure(config: pytest.Config) -> None:
    # The tests are a user of the library, so the global configuration is theirs to set: no start-up banner and no
    # line per compiled module between the results.
    wp.config.log_level = wp.LOG_WARNING
    wp.init()
    wp.set_device(config.getoption("--device"))  # tests of one device name it


def _mark_slow_rows(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark the rows slow that ``slow_rows`` names.

    Raises:
        pytest.UsageError: it names one that does not exist.
    """
    missing = {}
    for item in items:
        for mark in item.iter_markers("slow_rows"):
            row = getattr(item, "callspec", None) and item.callspec.id
            if row in mark.args:
                item.add_marker(pytest.mark.slow)
            missing.setdefault(item.location[0] + "::" + item.originalname, set(mark.args)).discard(row)
    wrong = {name: rows for name, rows in missing.items() if rows}
    if wrong and not any("::" in arg for arg in config.args):  # else only some rows are collected
        raise pytest.UsageError(f"slow_rows of what no row is called: {wrong}")


def pytest_report_header(config: pytest.Config) -> str:
    devices = ", ".join(str(device) for device in wp.get_devices())
    return f"warp {wp.__version__}, devices: {devices}" + ("" if _has_cuda() else "; tests marked gpu are deselected")


@pytest.hookimpl(tryfirst=True)  # before ``-m`` selects
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    _mark_slow_rows(config, items)
    if _has_cuda():
        return
    gpu = [item for item in items if item.get_closest_marker("gpu")]
    if gpu:
        config.hook.pytest_deselected(items=gpu)
        items[:] = [item for item in items if not item.get_closest_marker("gpu")]


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> object:
    """Give a worker whole files: tests of one file share kernels, which two workers would both compile."""
    if config.getvalue("dist") != "load":
        return None
    config.option.loadscopereorder = False  # xdist would leave files of few tests, some of them long, to the end

    class Scheduling(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = nodeid.partition("::")[0]
            return next((folder for folder in TOGETHER if file.startswith(folder)), file)

    return Scheduling(config, log)


@pytest.fixture(params=["cpu", pytest.param("cuda:0", marks=pytest.mark.gpu)])
def device(request: pytest.FixtureRequest) -> str:
    """Every device that a kernel has to agree on."""
    return request.param
