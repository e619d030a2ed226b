// MathJax 3.2.2 (Apache-2.0, LICENSE-MathJax.txt), in tex-svg.js, for pages that hold equations.
window.MathJax = {
  tex: {inlineMath: [["\\(", "\\)"]], displayMath: [["\\[", "\\]"]], processEscapes: true},
  options: {ignoreHtmlClass: ".*|", processHtmlClass: "arithmatex", enableMenu: false},
};
if (document.querySelector(".arithmatex")) {
  const script = document.createElement("script");
  script.src = document.currentScript.src.replace("mathematics.js", "tex-svg.js");
  document.head.append(script);
}
