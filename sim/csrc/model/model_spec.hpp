// ModelSpec collects the definitions of a scene, checks each, and builds the Model.
#pragma once

#include <unordered_set>

#include "model/definitions.hpp"
#include "model/model.hpp"

namespace gelflow {

// The definitions of a scene, in the order in which they were added.
struct Definitions {
  std::vector<BodyDef> bodies;
  std::vector<JointDef> joints;
  std::vector<ShapeDef> shapes;
  std::vector<PointsDef> points;
  std::vector<ContactDef> contacts;
  std::vector<PadDef> pads;
  std::vector<TendonDef> tendons;
  std::vector<CouplingDef> couplings;
  std::vector<LoopClosureDef> loop_closures;
  std::vector<ActuatorDef> actuators;
};

// Each add_* returns the index of the element among its kind, and throws std::invalid_argument where the definition is
// inconsistent or refers to an element that was not added before.
class ModelSpec {
 public:
  V3<double> gravity{0, 0, -9.8};  // [m/s²]
  SolverOptions options;
  std::string integrator = "bdf1";  // or bdf2

  int add_body(const BodyDef& def);
  int add_joint(const JointDef& def);
  int add_shape(const ShapeDef& def);
  int add_points(const PointsDef& def);
  int add_contact(const ContactDef& def);
  int add_pad(const PadDef& def);
  int add_tendon(const TendonDef& def);
  int add_coupling(const CouplingDef& def);
  int add_loop_closure(const LoopClosureDef& def);
  int add_actuator(const ActuatorDef& def);

  const Definitions& definitions() const { return definitions_; }
  Model build() const;

 private:
  Definitions definitions_;
  std::vector<const char*> param_kinds_;        // of the element that has the parameter
  std::unordered_set<std::string> used_names_;  // kinds and parameters
  std::vector<int> point_sets_;                 // of each PointsDef in the model, where pads add sets of their own
  Model model_;                                 // without what depends on all definitions (build)

  void check_body(const std::string& owner, int body, bool world_allowed) const;
  template <template <class> class Params>
  ParamBlock<Params> add_params(const char* kind, const std::string& owner, const Params<double>& values);
  void name_kinds(Model& model) const;
  ParamBlock<PoseParams> add_pose(const char* kind, const std::string& owner, const V3<double>& pos);
  void add_dofs(const Joint& joint, bool prescribed);
  void add_pad_contacts(const Pad& pad);
  const Joint& scalar_joint(const std::string& owner, int joint) const;
  int add_anchors(FrictionLaw law, int count);
};

// The parts of a model that follow from all its elements: dofs per body, ancestors, the dofs of each pair of bodies, and
// the leaders that couplings end at.
void build_kinematic_tree(Model& model);
void build_contact_pairs(Model& model);
void build_couplings(Model& model);

}  // namespace gelflow
