"""The texts of options: a command's own come before those that commands share."""

from hybrid.run.option_texts import option_texts


def test_a_commands_own_text_replaces_the_shared_one():
    own, shared = option_texts("simulate")["frames"], option_texts("denoise")["frames"]
    assert own == {"panel": "Input", "metavar": "RANGE", "help": "such as 1001-1010x2"}
    assert shared["help"].startswith("frames to use")


def test_a_text_alone_is_the_help():
    assert option_texts("train")["ema"] == {
        "panel": "Training",
        "help": "decay of the moving average of the weights, which is validated and saved",
    }
