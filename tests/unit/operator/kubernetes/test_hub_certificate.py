"""The certificates of the hubs of a RosProxy: always the same, and for this RosProxy alone."""

from cryptography import x509
from cryptography.hazmat.primitives import serialization
from msgspec.structs import replace

from rosproxy.shared.setting_kinds import read_hub_certificate
from rosproxy_operator.kubernetes.planner import manifests
from rosproxy_operator.kubernetes.planner.actions import CreateProxy, DeleteProxy
from rosproxy_operator.kubernetes.proxies.hub_certificate import (
    hub_certificate,
    hub_certificates,
)
from rosproxy_operator.kubernetes.resources import names
from rosproxy_operator.kubernetes.resources.model import Name, Ros2Spec
from tests.run_options import settings_of
from tests.unit.operator.kubernetes import objects as some
from tests.unit.operator.kubernetes.objects import SETTINGS, done, look, node, proxy, site
from tests.unit.operator.kubernetes.test_zenoh import env_of, ofz, pod, proxy_of, seen

KEY = bytes(range(32))
OF = Name("ros", "robot")
VARIABLE = "ROSPROXY_ZENOH_HUB_CERTIFICATE"


def test_the_text_is_always_the_same() -> None:
    text = hub_certificate(KEY, OF)
    hub_certificate.cache_clear()
    assert hub_certificate(KEY, OF) == text
    others = [hub_certificate(bytes(32), OF), hub_certificate(KEY, Name("ros", "arm"))]
    assert len({text, *others}) == 3


def test_the_certificate_holds_for_the_names_that_other_hubs_dial() -> None:
    given = read_hub_certificate(hub_certificate(KEY, OF))
    assert given is not None
    certificate = x509.load_pem_x509_certificate(given.certificate)
    authority = x509.load_pem_x509_certificate(given.ca)
    certificate.verify_directly_issued_by(authority)
    alternative = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName)
    (name,) = alternative.value.get_values_for_type(x509.DNSName)
    first, _, domain = names.hub_address(OF, "node-1.example").host.partition(".")
    assert name == f"*.{domain}"
    assert first
    key = serialization.load_pem_private_key(given.key, None)
    assert key.public_key() == certificate.public_key()
    assert certificate.public_key() != authority.public_key()
    assert certificate.not_valid_after_utc.year == 9999


def test_only_rosproxies_for_rmw_zenoh_have_one_and_only_with_a_key() -> None:
    of = ofz()
    assert [*hub_certificates([of, some.rosproxy(ros1=False, ros2=Ros2Spec())], KEY)] == [of.id]
    assert not hub_certificates([of], b"")


def test_all_proxies_of_a_rosproxy_have_the_same() -> None:
    of = ofz()
    certificates = hub_certificates([of], KEY)
    pods = (pod(), pod(name="b", on="two"))
    plan = look(seen(of, node(), node("two"), *pods, hub_certificates=certificates))
    made = [action for action in done(plan) if isinstance(action, CreateProxy)]
    assert [env_of(action.body)[VARIABLE] for action in made] == [certificates[of.id]] * 2
    settings = settings_of(env_of(made[0].body))
    assert settings.zenoh_hub_certificate == read_hub_certificate(certificates[of.id])
    assert settings.zenoh_hub_listen == names.HUB_PORT
    assert settings.zenoh_listen is None


def test_another_key_makes_only_the_proxies_for_rmw_zenoh_anew() -> None:
    of = ofz()
    certificates = [hub_certificates([of], key) for key in (KEY, bytes(32))]
    place = replace(site(of, node(), names.ROUTERS), hub_certificate=certificates[0][of.id])
    fingerprint = manifests.proxy_fingerprint(place, SETTINGS)
    present = replace(proxy_of(of), fingerprint=fingerprint)
    assert not done(look(seen(of, pod(), present, hub_certificates=certificates[0])))
    (action,) = done(look(seen(of, pod(), present, hub_certificates=certificates[1])))
    assert isinstance(action, DeleteProxy)
    other = some.rosproxy()
    kept = seen(other, some.pod(), proxy(other), hub_services={})
    for given in certificates:
        assert not done(look(replace(kept, hub_certificates=given)))
