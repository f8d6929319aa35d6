// Draws the figures that the report carries.
(() => {
  const read = (node) => JSON.parse(node.textContent);
  const templates = read(document.getElementById('templates'));
  const dark = matchMedia('(prefers-color-scheme: dark)');
  const config = { displaylogo: false, responsive: true, toImageButtonOptions: { format: 'svg' }, modeBarButtonsToRemove: ['sendChartToCloud'] };
  const draw = () => {
    for (const plot of document.querySelectorAll('.plot')) {
      const { data, layout } = read(document.getElementById(plot.dataset.source));
      layout.template = templates[dark.matches ? 'dark' : 'light'];
      Plotly.react(plot, data, layout, config);
    }
  };
  dark.addEventListener('change', draw);
  draw();
})();
