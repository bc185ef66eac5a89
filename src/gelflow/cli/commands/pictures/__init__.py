"""Commands that draw and show: render, render-scene, view."""
