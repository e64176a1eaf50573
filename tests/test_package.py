"""Laws of the package as a whole."""

import subprocess
import sys


def run_python(code: str) -> str:
    return subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout


def test_importing_sliplens_imports_neither_torch_nor_numpy():
    loaded = run_python(
        "import sys, sliplens; print([m for m in ('torch', 'numpy', 'matplotlib') if m in sys.modules])"
    )
    assert loaded.strip() == "[]"


def test_asking_for_help_does_not_import_torch():
    code = (
        "import sys\nfrom sliplens.cli import main\n"
        "try:\n    main(['train', '--help'])\nexcept SystemExit:\n    pass\n"
        "print('torch' in sys.modules)"
    )
    assert run_python(code).strip().endswith("False")


def test_importing_the_report_does_not_import_torch():
    assert run_python("import sys, sliplens.report; print('torch' in sys.modules)").strip() == "False"
