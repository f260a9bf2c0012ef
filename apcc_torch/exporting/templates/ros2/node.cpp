// @origin@
// An example node for ROS 2. NOT BUILT where it was written: read it, build it, check it before it moves anything.
#include <geometry_msgs/msg/point_stamped.hpp>
#include <geometry_msgs/msg/pose_array.hpp>
#include <rclcpp/rclcpp.hpp>
#include <std_msgs/msg/float64_multi_array.hpp>

#include "@name@.hpp"

namespace {

// The homogeneous matrix of a pose, row by row.
void to_matrix(const geometry_msgs::msg::Pose& pose, @name@::Real (&T)[4][4]) {
    const double w = pose.orientation.w, x = pose.orientation.x, y = pose.orientation.y, z = pose.orientation.z;
    const double matrix[4][4] = {
        {1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), pose.position.x},
        {2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x), pose.position.y},
        {2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y), pose.position.z},
        {0, 0, 0, 1},
    };
    for (int i = 0; i < 16; ++i) T[i / 4][i % 4] = static_cast<@name@::Real>(matrix[i / 4][i % 4]);
}

class ControllerNode : public rclcpp::Node {
   public:
    ControllerNode() : Node("@name@"), measurement_(@name@::all_sensors()) {
        told_ = create_publisher<std_msgs::msg::Float64MultiArray>("@told@", 1);
        targets_ = create_subscription<geometry_msgs::msg::PointStamped>(
            "target", 1, [this](const geometry_msgs::msg::PointStamped& message) {
                target_.x_d[0] = static_cast<@name@::Real>(message.point.x);
                target_.x_d[1] = static_cast<@name@::Real>(message.point.y);
                target_.x_d[2] = static_cast<@name@::Real>(message.point.z);
                aimed_ = true;
            });
// @if tendons@
        tendons_ = create_subscription<std_msgs::msg::Float64MultiArray>(
            "tendons", 1, [this](const std_msgs::msg::Float64MultiArray& message) {
                if (message.data.size() != @name@::tendons) return;
                for (int a = 0; a < @name@::tendons; ++a)
                    measurement_.tendons[a] = static_cast<@name@::Real>(message.data[a]);
            });
// @end@
        poses_ = create_subscription<geometry_msgs::msg::PoseArray>(
            "poses", rclcpp::SensorDataQoS(), [this](const geometry_msgs::msg::PoseArray& message) { seen(message); });
    }

   private:
    void seen(const geometry_msgs::msg::PoseArray& message) {
        if (message.poses.size() != @name@::sensors) {
            RCLCPP_WARN_THROTTLE(get_logger(), *get_clock(), 1000, "%zu poses, not @sensors@", message.poses.size());
            return;
        }
        for (int k = 0; k < @name@::sensors; ++k) to_matrix(message.poses[k], measurement_.T[k]);
        const double now = rclcpp::Time(message.header.stamp).seconds();
        if (!begun_) {  // once: the shape in which the arm hangs
            controller_.warm_up(measurement_, 100, @period@, now);
            begun_ = true;
        }
        if (!aimed_) return;
        measurement_.time = now;
        const @name@::Command& command = controller_.step(measurement_, target_);
        if (command.status == @NAME@_INVALID) return;
        std_msgs::msg::Float64MultiArray out;
        out.data.assign(command.@wanted@, command.@wanted@ + @name@::tendons);
        told_->publish(out);
    }

    @name@::Controller controller_;
    @name@::Measurement measurement_;
    @name@::Target target_{};
    bool begun_ = false, aimed_ = false;
    rclcpp::Publisher<std_msgs::msg::Float64MultiArray>::SharedPtr told_;
    rclcpp::Subscription<geometry_msgs::msg::PointStamped>::SharedPtr targets_;
// @if tendons@
    rclcpp::Subscription<std_msgs::msg::Float64MultiArray>::SharedPtr tendons_;
// @end@
    rclcpp::Subscription<geometry_msgs::msg::PoseArray>::SharedPtr poses_;
};

}  // namespace

int main(int argc, char** argv) {
    rclcpp::init(argc, argv);
    rclcpp::spin(std::make_shared<ControllerNode>());
    rclcpp::shutdown();
    return 0;
}
