"""Makes the synchronous client from the asynchronous one, which alone is written by hand.

unasync.py            writes src/polscan/_client.py
unasync.py --check    ends with 1 where it is not what would be written
"""

import re
import sys
from pathlib import Path

FOLDER = Path(__file__).resolve().parents[1] / "src" / "polscan"
WORDS = {
    "AsyncScanner": "Scanner", "AsyncScan": "Scan", "AsyncCalibration": "Calibration",
    "AsyncClient": "Client", "AsyncGenerator": "Generator", "AsyncBaseTransport": "BaseTransport",
    "__aenter__": "__enter__", "__aexit__": "__exit__", "aclose": "close", "aread": "read",
    "aiter_bytes": "iter_bytes", "aiter_raw": "iter_raw",
}  # fmt: skip
HEAD = '"""The synchronous client. Made from `_async_client.py` by `tools/unasync.py`: change that one."""\n'


def synchronous(source: str) -> str:
    """The same without `async` and `await`."""
    source = HEAD + source.split("\n", 1)[1]
    source = re.sub(r"\b(async|await) ", "", source)
    source = re.sub(r"AsyncGenerator\[(\w+), None\]", r"Generator[\1, None, None]", source)
    source = source.replace("_pause.wait(", "_pause.sleep(")
    return re.sub(r"\w+", lambda word: WORDS.get(word[0], word[0]), source)


def main() -> int:
    """Writes or checks."""
    target = FOLDER / "_client.py"
    made = synchronous((FOLDER / "_async_client.py").read_text())
    if "--check" not in sys.argv[1:]:
        target.write_text(made)
        return 0
    if target.read_text() == made:
        return 0
    print(f"{target} is not made from _async_client.py; run tools/unasync.py", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main())
