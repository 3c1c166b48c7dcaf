"""Keeping a valid certificate for the admission webhook: in a Secret, or from a directory."""

import asyncio
import base64
import logging
from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path

from rosproxy_operator.common.metrics import ClusterMetrics
from rosproxy_operator.common.problem import Problem, ProblemLog
from rosproxy_operator.common.threads import in_thread
from rosproxy_operator.kubernetes.api import (
    WEBHOOKS,
    Api,
    ApiAway,
    ApiConflict,
    ApiError,
    ApiGone,
    ApiInvalid,
)
from rosproxy_operator.kubernetes.resources.model import Json, Name
from rosproxy_operator.kubernetes.resources.values import part, parts, words
from rosproxy_operator.kubernetes.settings import WebhookSettings
from rosproxy_operator.kubernetes.webhook import certificates
from rosproxy_operator.kubernetes.webhook.certificates import InvalidCertificate, KeyPair

log = logging.getLogger(__name__)

EVERY = 20.0
"""Seconds between two checks: a certificate that is due, a CA that somebody has overwritten."""
EVERY_DIRECTORY = 10.0
"""The same for a certificate that somebody else puts into a directory."""
OVERLAP = 10.0
"""Seconds from trusting a new CA to serving its certificate: API servers learn of it by a watch."""
_SUBJECT = "webhook"


class CertificateDirectory:
    """A certificate that somebody else renews, cert-manager for one, as a mounted Secret."""

    every = EVERY_DIRECTORY
    problems: Sequence[Problem] = ()

    def __init__(self, directory: str) -> None:
        self._directory = Path(directory)

    def refresh(self) -> KeyPair:
        """What is there now. Raises InvalidCertificate."""
        names = certificates.CERTIFICATE, certificates.KEY
        try:
            found = [(self._directory / name).read_bytes() for name in names]
            return certificates.checked(KeyPair(*found))
        except OSError as error:
            text = f"--webhook-cert-dir: {error.filename}: {error.strerror}"
            raise InvalidCertificate(text) from None
        except InvalidCertificate as error:
            raise InvalidCertificate(f"--webhook-cert-dir {self._directory}: {error}") from None


class SelfSigned:
    """A certificate that is made here, kept in a Secret, its CA in the webhook's configuration.

    First a new CA is trusted, together with the one before, then its certificate is served; so
    there is no moment at which an API server refuses what is served.
    """

    every = EVERY

    def __init__(
        self,
        api: Api,
        names: list[str],
        secret: Name | None,
        configuration: str,
        now: Callable[[], datetime] = certificates.now,
    ) -> None:
        self._api, self._names, self._now = api, names, now
        self._secret, self._configuration = secret, configuration
        self._pair: KeyPair | None = None
        self._serving: KeyPair | None = None
        self._trusted_at: datetime | None = None
        self.problems: list[Problem] = []

    def refresh(self) -> KeyPair:
        """Renew it if it is due, and see to it that its CA is trusted. Raises ApiError."""
        self.problems = []
        now, self._pair = self._now(), self._kept()
        trusted = self._trust(self._pair.ca)
        if self._serving is None or self._serving.expires <= now or not self._configuration:
            self._serving = self._pair
        elif self._pair != self._serving and trusted:
            # API servers are to have the time to learn of the new CA.
            self._trusted_at = self._trusted_at or now
            if (now - self._trusted_at).total_seconds() >= OVERLAP:
                self._serving, self._trusted_at = self._pair, None
        return self._serving

    def _kept(self) -> KeyPair:
        """The pair in the Secret, else this process's own; a new one if it does not do (any more).

        It does if it is for our names and has not lived too long.
        """
        there: Json | None = None
        try:
            there = self._api.get("secrets", self._secret) if self._secret else None
        except ApiError as error:
            if self._pair is None and isinstance(error, ApiAway):
                raise
            self._complain(error)
        found = self._pair if there is None else self._read(there)
        if found and not found.due(self._now()) and found.names() >= set(self._names):
            return found
        before = found or self._pair
        pair = certificates.make(self._names, self._now(), before.ca if before else b"")
        if self._secret and there is not None:
            self._put(self._secret, pair, there)
        return pair

    def _put(self, secret: Name, pair: KeyPair, there: Json) -> None:
        """Write a pair into the Secret. Whoever was faster has the right one."""
        try:
            self._api.fill_secret(secret, there, pair.secret())
        except (ApiInvalid, ApiConflict) as error:
            raise ApiAway(f"somebody else writes {secret}: {error}") from None
        except ApiError as error:
            self._complain(error)
        log.info("webhook: made a certificate that is valid until %s", pair.expires)

    def _complain(self, error: ApiError) -> None:
        """Tell that the Secret can't be used: the certificate is then this process's alone.

        That the API server is away the operator's looks tell.
        """
        if isinstance(error, ApiAway):
            return
        text = f"Secret {self._secret}: {error}; the certificate is kept in memory meanwhile"
        if isinstance(error, ApiGone):
            text += "; create an empty Secret of this name (the chart does)"
        self.problems.append(Problem(_SUBJECT, text))

    def _read(self, secret: Json) -> KeyPair | None:
        data = words(secret, "data")
        if not data.get(certificates.KEY):
            return None
        try:
            return certificates.read(data)
        except InvalidCertificate as error:
            log.warning("webhook: Secret %s: %s; making another one", self._secret, error)
            return None

    def _trust(self, authorities: bytes) -> bool:
        """Write the CAs where the API server looks for them; whether they are there."""
        if not self._configuration:
            return True
        try:
            name = Name("", self._configuration)
            operations = _trust_patch(self._api.get(WEBHOOKS, name), authorities)
            if operations:
                self._api.patch(WEBHOOKS, name, operations)
                log.info("webhook: its CA is now in %s", self._configuration)
        except ApiError as error:
            text = f"MutatingWebhookConfiguration {self._configuration}: {error}"
            if isinstance(error, ApiGone):
                text += "; without it no pod is wired: install it anew (the chart has it)"
            if not isinstance(error, ApiAway):
                self.problems.append(Problem(_SUBJECT, text))
            return False
        return True


def _trust_patch(configuration: Json, authorities: bytes) -> list[Json]:
    """The JSON patch that makes a configuration's webhooks trust these CAs; empty if they do."""
    bundle = base64.b64encode(authorities).decode()
    operations: list[Json] = []
    for index, webhook in enumerate(parts(configuration, "webhooks")):
        if part(webhook, "clientConfig").get("caBundle") != bundle:
            where = f"/webhooks/{index}"
            operations += [
                {"op": "test", "path": f"{where}/name", "value": webhook.get("name")},
                {"op": "add", "path": f"{where}/clientConfig/caBundle", "value": bundle},
            ]
    return operations


class CertificateRotation:
    """Holds the certificate that is to be served. `pair` may be read from any thread."""

    def __init__(self, source: CertificateDirectory | SelfSigned, metrics: ClusterMetrics) -> None:
        self.pair: KeyPair | None = None
        self._source, self._metrics = source, metrics
        self._log = ProblemLog()

    async def run(self) -> None:
        """Keep it valid until cancelled, whatever happens."""
        while True:
            await self.refresh()
            await asyncio.sleep(self._source.every if self.pair else 2.0)

    async def refresh(self) -> None:
        """Check it once, and renew it if it is due."""
        try:
            pair = await in_thread(self._source.refresh)
        except (ApiError, InvalidCertificate) as error:
            problems = [Problem(_SUBJECT, f"no certificate: {error}")]
        except Exception as error:  # a mistake of ours must not end the certificate
            log.exception("checking the webhook's certificate failed; going on")
            problems = [Problem(_SUBJECT, f"the operator failed: {error!r}")]
        else:
            problems = [*self._source.problems]
            if pair != self.pair:
                log.info("webhook: serving a certificate that is valid until %s", pair.expires)
            self.pair = pair
            self._metrics.certificate_expiry.set(pair.expires.timestamp())
        self._log.update(problems)


def source(api: Api, settings: WebhookSettings) -> CertificateDirectory | SelfSigned:
    """Where the certificate comes from, by the settings."""
    if settings.directory or settings.service is None:
        return CertificateDirectory(settings.directory)
    names = certificates.service_names(settings.service.namespace, settings.service.name)
    return SelfSigned(api, names, settings.secret, settings.configuration)
