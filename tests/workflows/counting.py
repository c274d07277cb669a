"""Counts the measures of rollouts."""

from eddies.workflows.rollout.particle_measures import ParticleSpectra, ReconstructedFields


def count_measures(monkeypatch, noted):
    """Call noted(quantity, particles, frame) before each computation of gradients or of a spectrum."""
    gradients, spectrum = ReconstructedFields.gradients, ParticleSpectra.of

    def noted_gradients(self, frame):
        noted("gradients", self.particles, frame)
        return gradients(self, frame)

    def noted_spectrum(self, particles, frame, whose):
        noted("spectrum", particles, frame)
        return spectrum(self, particles, frame, whose)

    monkeypatch.setattr(ReconstructedFields, "gradients", noted_gradients)
    monkeypatch.setattr(ParticleSpectra, "of", noted_spectrum)
