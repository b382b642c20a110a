"""What makes of a sharp mirror's picture what a real one shows; one finish a file, on any technique's layer.

A finish's module has

    apply(scene, shown, layer, sharp, radiance, row) -> radiance

with `shown` the frame's `shade.Shown`, `layer` the reflector's answer, `sharp` what its pixels see in a sharp mirror,
`radiance` what the finishes before made of that (vec3 [layer.pixels.count] each, not to be written to; the mirror's own
weight comes later), and `row` the reflector's `PlanRow`. `effects.FINISHES` names the effects that turn them on. Where it says
what transparent surfaces do with what is behind them (`effects.PANE_FINISHES`), it has

    apply_through(scene, through, found, radiance, pane) -> radiance

with `through` a `transmission.Through`, `found` the surface's `Transmission`, and `pane` its `PaneRow`. Nothing here is
imported, compiled or launched unless a planned effect is on.
"""
