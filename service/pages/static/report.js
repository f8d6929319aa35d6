// Draws the figures that the report carries.
(() => {
  const read = (node) => JSON.parse(node.textContent);
  const templates = read(document.getElementById('templates'));
  const dark = matchMedia('(prefers-color-scheme: dark)');
  const config = { displaylogo: false, responsive: true, toImageButtonOptions: { format: 'svg' }, modeBarButtonsToRemove: ['sendChartToCloud'] };
  const draw = () => {
    const isDark = dark.matches && !document.body.classList.contains('printing'); // paper is white
    for (const plot of document.querySelectorAll('.plot')) {
      const { data, layout } = read(document.getElementById(plot.dataset.source));
      layout.template = templates[isDark ? 'dark' : 'light'];
      Plotly.react(plot, data, layout, config);
      Plotly.relayout(plot, { autosize: true });
    }
  };
  const drawFor = (isPrinting) => {
    document.body.classList.toggle('printing', isPrinting);
    draw();
  };
  dark.addEventListener('change', draw);
  addEventListener('beforeprint', () => drawFor(true));
  addEventListener('afterprint', () => drawFor(false));
  draw();
})();
