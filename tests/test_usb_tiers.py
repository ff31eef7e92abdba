"""Drivers, libraries and kernel on emulated devices: tiers B and C, where this machine can."""

from __future__ import annotations

from pathlib import Path

import pytest
from emulated.tiers import JOBS, Job


@pytest.mark.parametrize("job", JOBS, ids=lambda job: job.name)
def test_what_a_tier_claims_holds(job: Job, tmp_path: Path) -> None:
    if (reason := job.missing()) is not None:
        pytest.skip(reason)
    claims = job.run(tmp_path)
    failed = [f"{claim.name}: {claim.note}" for claim in claims if not claim.is_true]
    assert not failed, "\n".join(failed)
    assert claims
