"""A warning is recognised again by its key, whatever numbers its words hold."""

import pickle

from parallel_cal.base.keyed_warning import KeyedWarning, warning_key
from parallel_cal.recordings.gate import Gate


def test_two_warnings_with_other_numbers_have_one_key():
    few, many = (KeyedWarning(f"leg1: {n} lost", "lost", "leg1") for n in (3, 40))
    assert few != many
    assert warning_key(few) == warning_key(many) == ("lost", "leg1")


def test_words_with_the_same_key_but_another_subject_are_another_warning():
    assert warning_key(KeyedWarning("a", "lost", "leg1")) != warning_key(
        KeyedWarning("a", "lost", "leg2")
    )


def test_plain_words_are_their_own_key():
    assert warning_key("no metadata.yaml") == ("no metadata.yaml", "")


def test_a_warning_keeps_its_key_on_the_way_to_another_process():
    warning = pickle.loads(pickle.dumps(KeyedWarning("leg1: 3 lost", "lost", "leg1")))
    assert (warning, warning_key(warning)) == ("leg1: 3 lost", ("lost", "leg1"))


def test_a_growing_count_of_dropped_messages_is_one_warning():
    gate, second = Gate("joint_states"), 1_000_000_000
    found = []
    for k in range(1, 9):
        stamp = k * second // 100 + (5 * second if k in (3, 6) else 0)
        gate.take(stamp, k * second // 100, k, None)
        found.append(gate.trouble)
    one, two = dict.fromkeys(text for text in found if text)
    assert one != two
    assert warning_key(one) == warning_key(two)
