"""Check the machine: ``mitsim doctor``."""

from __future__ import annotations

from dataclasses import asdict

import typer

from mitsim.cli import options


def doctor(json: options.Json = False) -> None:
    """Check this machine: list what is present, what is missing, and how to fix it.

    Exit code 3 if something that mitsim needs is missing.

    Example: mitsim doctor
    """
    import json as json_module

    from mitsim.cli.doctor import examine

    findings = examine()
    if json:
        print(json_module.dumps([asdict(finding) for finding in findings], indent=2))
    else:
        for finding in findings:
            print(f"{finding.verdict:8} {finding.what:32} {finding.detail}")
            if finding.fix:
                print(f"{'':8} {'':32} -> {finding.fix}")
    if any(finding.verdict == "missing" for finding in findings):
        raise typer.Exit(3)
