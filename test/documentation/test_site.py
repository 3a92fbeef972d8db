"""The site of docs/ is built without a complaint; each topic is described."""

import pytest

from documentation import build, reference
from limb_interfaces import topics


@pytest.mark.slow
def test_the_site_is_built_without_a_warning_and_its_tutorials_run():
    assert build.build() == 0


def test_each_topic_has_a_text():
    names = {value for name, value in vars(topics).items() if name.isupper()}
    assert dict(reference.topic_texts()).keys() == names - {topics.NAMESPACE, topics.BASE_FRAME}
