"""OpenVLA-OFT's learning rate follows the recipe's warm-up and cosine, from whichever step it starts."""

import pytest
import torch

from pipeline.clients.templates.run_openvla_oft import read_schedule, set_optimiser


@pytest.mark.parametrize(
    ("words", "first", "shares"),
    [
        ([], 0, {0: 0.05, 19: 1, 20: 1, 1010: 0.5, 2000: 0}),
        (["--max_steps", "400"], 0, {0: 0.25, 3: 1, 4: 1, 202: 0.5, 400: 0}),
        (["--max_steps=200", "--lr_warmup_steps=0"], 0, {0: 1, 100: 0.5, 200: 0}),
        (["--max_steps", "1_000", "--lr_warmup_steps", "10"], 0, {0: 0.1, 9: 1, 10: 1, 505: 0.5, 1000: 0}),
        (["--resume", "true", "--resume_step", "1010"], 1010, {1010: 0.5, 2000: 0}),
        (["--resume=True", "--resume_step=4", "--max_steps=900"], 4, {4: 5 / 9, 8: 1, 9: 1, 900: 0}),
        (["--resume", "False", "--resume_step", "300"], 0, {0: 0.05, 19: 1, 1010: 0.5, 2000: 0}),
    ],
)
def test_the_rate_follows_steps_warm_up_and_resumption(
    words: list[str], first: int, shares: dict[int, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    for module, name in ((torch.optim, "AdamW"), (torch.optim.lr_scheduler, "MultiStepLR")):
        monkeypatch.setattr(module, name, getattr(module, name))  # restored after the test
    set_optimiser(0.1, read_schedule(words, steps=2000, warmup_steps=20))
    optimizer = torch.optim.AdamW([torch.nn.Parameter(torch.zeros(1))], lr=5e-4)
    scheduler = torch.optim.lr_scheduler.MultiStepLR(optimizer, milestones=[100_000], gamma=0.1)
    rates = {}
    for step in range(first, max(shares) + 1):
        rates[step] = optimizer.param_groups[0]["lr"]
        optimizer.step()
        scheduler.step()
    assert {step: rates[step] for step in shares} == pytest.approx({k: 5e-4 * v for k, v in shares.items()}, abs=1e-12)


def test_a_checkpoint_of_another_training_begins_a_schedule_of_its_own() -> None:
    words = ["--resume", "True", "--resume_step", "150_000", "--max_steps", "170_000"]
    schedule = read_schedule(words, steps=100_000, warmup_steps=1000, restart=True)
    shares = {step: schedule.share(step) for step in (0, 199, 200, 10_100, 20_000)}
    assert shares == pytest.approx({0: 1 / 200, 199: 1, 200: 1, 10_100: 0.5, 20_000: 0})


@pytest.mark.parametrize(
    ("words", "restart", "said"),
    [
        (["--resume", "True", "--resume_step", "150000"], False, "--max_steps 250000 for 100000 more"),
        (["--resume", "True", "--resume_step", "150000"], True, "150000 is not below --max_steps 100000"),
        (["--resume_step", "150000", "--max_steps", "170000"], True, "--statistics without --resume"),
    ],
)
def test_a_resumption_that_would_train_something_else_is_rejected(words: list[str], restart: bool, said: str) -> None:
    with pytest.raises(SystemExit, match=said):
        read_schedule(words, steps=100_000, warmup_steps=1000, restart=restart)
