import matplotlib

from eddies.report.figures import panels, png, styled


def test_drawing_leaves_the_settings_of_the_user(monkeypatch):
    monkeypatch.setitem(matplotlib.rcParams, "backend", "svg")
    monkeypatch.setitem(matplotlib.rcParams, "font.size", 20.0)

    @styled
    def draw():
        figure, axes = panels(1, 1, (2, 2))
        assert matplotlib.rcParams["font.size"] == 10.5
        return figure

    assert png(draw()).startswith(b"\x89PNG")
    assert matplotlib.rcParams["backend"] == "svg" and matplotlib.rcParams["font.size"] == 20
