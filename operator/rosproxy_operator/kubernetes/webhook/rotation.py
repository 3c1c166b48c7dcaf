"""Keeps a valid certificate for the admission webhook, in a Secret or from a directory."""

import asyncio
import base64
import logging
import time
from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path

from rosproxy_operator.common.operator_metrics import ClusterMetrics
from rosproxy_operator.common.problem import (
    FAILED,
    Problem,
    ProblemLog,
)
from rosproxy_operator.common.threads import in_thread
from rosproxy_operator.kubernetes.api.api_client import (
    WEBHOOKS,
    Api,
    ApiConflict,
    ApiError,
    ApiInvalid,
    ApiNotFound,
    ApiUnavailable,
    NotLeading,
)
from rosproxy_operator.kubernetes.resources.checks import submap, submaps, texts_at
from rosproxy_operator.kubernetes.resources.model import Json, Name
from rosproxy_operator.kubernetes.settings import WebhookSettings
from rosproxy_operator.kubernetes.webhook import certificates
from rosproxy_operator.kubernetes.webhook.certificates import InvalidCertificate, KeyPair

log = logging.getLogger(__name__)

CHECK_INTERVAL_S = 20.0
"""Seconds between two checks for a certificate that is due, or a CA that was overwritten."""
DIRECTORY_CHECK_INTERVAL_S = 10.0
"""Seconds between two checks of a directory into which another program writes certificates."""
CA_TRUST_DELAY_S = 10.0
"""Least seconds from writing a new CA to serving the certificate of this CA.

API servers learn of the CA by a watch.
"""
_SUBJECT = "webhook"
_REASON = "CertificateFailed"


class CertificateDirectory:
    """A certificate that another program renews, such as cert-manager, in a mounted Secret."""

    check_interval_s = DIRECTORY_CHECK_INTERVAL_S
    problems: Sequence[Problem] = ()

    def __init__(self, directory: str) -> None:
        self._directory = Path(directory)

    def refresh(self) -> KeyPair:
        """Read the present certificate. Raises InvalidCertificate."""
        names = certificates.CERTIFICATE, certificates.KEY
        try:
            contents = [(self._directory / name).read_bytes() for name in names]
            return certificates.checked(KeyPair(*contents))
        except OSError as error:
            text = f"--webhook-cert-dir: {error.filename}: {error.strerror}"
            raise InvalidCertificate(text) from None
        except InvalidCertificate as error:
            raise InvalidCertificate(f"--webhook-cert-dir {self._directory}: {error}") from None


class NotMadeYet(Exception):
    """There is no certificate yet. Only the leading operator creates certificates."""


class SelfSigned:
    """A certificate that the operator creates, with the CA in the webhook's configuration.

    The certificate is in a Secret. All operators serve this certificate, and only the operator that
    ``leads`` writes. A renewal first writes the new CA beside the former CA, and the operators
    serve the new certificate later. So API servers trust the served certificate during a renewal.
    """

    check_interval_s = CHECK_INTERVAL_S

    def __init__(
        self,
        api: Api,
        names: list[str],
        secret: Name | None,
        configuration: str,
        now: Callable[[], datetime] = certificates.now,
        leads: Callable[[], bool] = lambda: True,
    ) -> None:
        self._api = api
        self._names = names
        self._now = now
        self._leads = leads
        self._secret = secret
        self._configuration = configuration
        self._pair: KeyPair | None = None
        self._unsaved: KeyPair | None = None
        self._serving: KeyPair | None = None
        self._trusted: tuple[KeyPair, datetime] | None = None
        self.problems: list[Problem] = []

    def refresh(self) -> KeyPair:
        """Return the certificate to serve. Renew the certificate if due, and write the CA.

        Raises ApiError, NotMadeYet.
        """
        self.problems = []
        now = self._now()
        self._pair = self._kept_pair()
        trusted = self._trust(self._pair.ca)
        # Serve the new certificate at once if the former certificate has expired. Without a
        # configuration there is no wait either: API servers get the CA by other means.
        if self._serving is None or self._serving.expires <= now or not self._configuration:
            self._serving = self._pair
        elif self._pair != self._serving and trusted:
            # API servers need time to learn of the new CA.
            if self._trusted is None or self._trusted[0] != self._pair:
                self._trusted = self._pair, now
            if (now - self._trusted[1]).total_seconds() >= CA_TRUST_DELAY_S:
                self._serving = self._pair
        return self._serving

    def _kept_pair(self) -> KeyPair:
        """The pair in the Secret, or the own pair if the Secret is unreadable; else a new pair.

        An operator that does not lead keeps a pair until the end of the lifetime. Raises ApiError,
        NotMadeYet.
        """
        manifest: Json | None = None
        try:
            manifest = self._api.get("secrets", self._secret) if self._secret else None
        except ApiError as error:
            if self._pair is None and isinstance(error, ApiUnavailable):
                raise  # the Secret may hold a good pair, so read the Secret first
            if not isinstance(error, ApiUnavailable):  # the operator's looks report ApiUnavailable
                self._complain(error)
        kept = self._pair if manifest is None else self._read(manifest)
        if kept and self._is_usable(kept):
            self._unsaved = None
            return kept
        if not self._leads():
            if kept and kept.expires > self._now():
                return kept
            raise NotMadeYet
        pair = self._new_pair(kept or self._pair)
        if self._secret and manifest is not None:
            self._put(self._secret, pair, manifest)
        return pair

    def _new_pair(self, previous: KeyPair | None) -> KeyPair:
        """A new pair in place of the previous pair. While writing fails, return the same new pair.

        With another pair at each try, API servers would have to learn of a new CA each time, and
        the number of trusted CAs would grow.
        """
        if self._unsaved is None or not self._is_usable(self._unsaved):
            trusted = previous.ca if previous else b""
            self._unsaved = certificates.make(self._names, self._now(), trusted)
            log.info("webhook certificate created: valid until %s", self._unsaved.expires)
        return self._unsaved

    def _is_usable(self, pair: KeyPair) -> bool:
        """Whether a pair has all our names and is not due."""
        return not pair.is_due(self._now()) and pair.names() >= set(self._names)

    def _put(self, secret: Name, pair: KeyPair, manifest: Json) -> None:
        """Write a pair into the Secret. Raises ApiUnavailable if another program has written first.

        The next refresh then reads the pair of that program.
        """
        try:
            self._api.fill_secret(secret, manifest, pair.secret())
        except (ApiInvalid, ApiConflict) as error:
            self._unsaved = None
            raise ApiUnavailable(f"another program has written Secret {secret}: {error}") from None
        except NotLeading:
            raise
        except ApiError as error:
            self._complain(error)

    def _complain(self, error: ApiError) -> None:
        """Report that the Secret is unusable, so only this process has the certificate."""
        text = f"Secret {self._secret}: {error}. The certificate is in memory only"
        is_missing = isinstance(error, ApiNotFound)
        fix = "Create an empty Secret of this name (the chart does so)" if is_missing else ""
        self.problems.append(Problem(_SUBJECT, text, fix, reason=_REASON))

    def _read(self, secret: Json) -> KeyPair | None:
        data = texts_at(secret, "data")
        if not data.get(certificates.KEY):
            return None
        try:
            return certificates.read(data)
        except InvalidCertificate as error:
            log.warning(
                "webhook certificate replaced: Secret %s has no usable certificate: %s",
                self._secret,
                error,
            )
            return None

    def _trust(self, authorities: bytes) -> bool:
        """Write the CAs into the webhook's configuration. Return whether the CAs are there.

        True without a configuration.
        """
        if not self._configuration:
            return True
        try:
            name = Name("", self._configuration)
            operations = _trust_patch(self._api.get(WEBHOOKS, name), authorities)
            if operations and not self._leads():
                return False
            if operations:
                self._api.patch(WEBHOOKS, name, operations)
                text = "webhook CA written: MutatingWebhookConfiguration %s"
                log.info(text, self._configuration)
        except ApiError as error:
            text = f"MutatingWebhookConfiguration {self._configuration}: {error}"
            fix = ""
            if isinstance(error, ApiNotFound):
                text += ". Without this object no pod is wired"
                fix = "Install the chart again"
            if not isinstance(error, ApiUnavailable):
                self.problems.append(Problem(_SUBJECT, text, fix, reason=_REASON))
            return False
        return True


def _trust_patch(configuration: Json, authorities: bytes) -> list[Json]:
    """The JSON patch that writes these CAs into a configuration; empty if the CAs are there."""
    bundle = base64.b64encode(authorities).decode()
    operations: list[Json] = []
    for index, webhook in enumerate(submaps(configuration, "webhooks")):
        if submap(webhook, "clientConfig").get("caBundle") != bundle:
            path = f"/webhooks/{index}"
            operations += [
                # A JSON patch names a webhook by its index, which changes if a webhook is added.
                {"op": "test", "path": f"{path}/name", "value": webhook.get("name")},
                {"op": "add", "path": f"{path}/clientConfig/caBundle", "value": bundle},
            ]
    return operations


class CertificateRotation:
    """Holds the certificate to serve. Any thread may read `pair`.

    ``not_made_yet``: the leading operator has not created the certificate yet. If the leading
    operator runs without webhook, no certificate comes until this operator leads.
    """

    def __init__(self, source: CertificateDirectory | SelfSigned, metrics: ClusterMetrics) -> None:
        self.pair: KeyPair | None = None
        self.not_made_yet = False
        self._source = source
        self._metrics = metrics
        self._log = ProblemLog()

    async def run(self) -> None:
        """Keep the certificate valid until cancelled. Log all errors."""
        while True:
            await self.refresh()
            await asyncio.sleep(self._source.check_interval_s if self.pair else 2.0)

    async def refresh(self) -> None:
        """Check the certificate once, and renew the certificate if due."""
        not_made_yet = False
        problems = list[Problem]()
        try:
            pair = await in_thread(self._source.refresh)
        except NotMadeYet:
            not_made_yet = True
            problems = [*self._source.problems]
        except (ApiError, InvalidCertificate) as error:
            text = f"the operator could not read or renew the certificate: {error}"
            problems = [Problem(_SUBJECT, text, reason=_REASON)]
        except Exception as error:  # a bug of ours must not end the checks
            text = "webhook certificate not checked by an internal error, the operator tries again"
            log.exception(text)
            problems = [Problem(_SUBJECT, f"the operator failed: {error!r}", reason=FAILED)]
        else:
            problems = [*self._source.problems]
            if pair != self.pair:
                log.info("webhook certificate served: valid until %s", pair.expires)
            self.pair = pair
            self._metrics.certificate_expiry.set(pair.expires.timestamp())
        self.not_made_yet = not_made_yet
        if problems or not not_made_yet:  # without a certificate, no earlier problem is solved
            self._log.update(problems, time.monotonic())


def certificate_source(
    api: Api, settings: WebhookSettings, leads: Callable[[], bool]
) -> CertificateDirectory | SelfSigned:
    """The source of the certificate, by the settings."""
    if settings.directory or settings.service is None:
        return CertificateDirectory(settings.directory)
    names = certificates.service_names(settings.service.namespace, settings.service.name)
    return SelfSigned(api, names, settings.secret, settings.configuration, leads=leads)
