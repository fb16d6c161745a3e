"""Distribution of test files over processes."""

from typing import Any

from xdist.scheduler import LoadFileScheduling


class FilesOnce(LoadFileScheduling):
    """Files by turns, where a test that ended its process failed: neither it nor a finished file is begun again.

    Otherwise pytest-xdist 3.8 begins such a test in nine processes, and gives a finished file to a process that then
    waits for ever.
    """

    def remove_node(self, node: Any) -> Any:
        files = self.assigned_work[node]
        unfinished = next(((tests, name) for tests in files.values() for name, done in tests.items() if not done), None)
        if unfinished is None:
            return super().remove_node(node)
        tests, ended = unfinished
        tests[ended] = True
        for file in [file for file, tests in files.items() if all(tests.values())]:
            del files[file]
        super().remove_node(node)
        return ended
